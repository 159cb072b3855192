def save_pictures(folder, evaluation, data):
    return []

"""The web app, an optional extra: estimate, explore a landscape, look at finished runs (see `commands.app`)."""

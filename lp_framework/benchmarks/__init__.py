"""What `bench` measures, a module each: two contenders side by side in one run, alternated round by round."""

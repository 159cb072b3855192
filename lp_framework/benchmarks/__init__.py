"""What `bench` measures, a module each, with the one harness that times contenders side by side."""

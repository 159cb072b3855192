"""The commands, one module each; `run(config)` takes the composed configuration."""

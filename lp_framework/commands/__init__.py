"""The commands, a module each: `run(config)` gets the composed configuration."""

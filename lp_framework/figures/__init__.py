"""The paper's figures by name, each of any data, prior and models."""

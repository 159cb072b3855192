"""The measurements of `bench`, one module each, and the shared harness that times both contenders."""

"""The application: turns a scene into a splat."""

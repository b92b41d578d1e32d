"""Commands of the engine, one module each."""

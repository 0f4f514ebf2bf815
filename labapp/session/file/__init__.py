"""The session file: database, schema, and serialisation of values."""

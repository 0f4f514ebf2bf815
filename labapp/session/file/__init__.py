"""The session file: a database, its schema, and values as bytes."""

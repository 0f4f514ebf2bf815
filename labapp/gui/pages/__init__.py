"""The steps of the guided way, one page each."""

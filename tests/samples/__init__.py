"""The sample recordings: ``python -m tests.samples DIR`` writes them all.

Each is simulated reproducibly from exact rays on known pools and stored with its truth.
"""

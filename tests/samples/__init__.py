"""The sample recordings: ``python -m tests.samples DIR`` writes them all anew.

Each is simulated from exact rays on known pools, the same every time, with its truth beside it.
"""

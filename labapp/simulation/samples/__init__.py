"""The sample recordings: ``python -m labapp.simulation.samples DIR`` writes them all anew.

Each is simulated from exact rays on known pools, the same every time, with its truth beside it.
"""

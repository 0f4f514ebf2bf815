"""What is computed with simulated pools: chapters 4 and 8, error budgets."""

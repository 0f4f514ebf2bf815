"""Initial labels, from which the labels of all dots are grown."""

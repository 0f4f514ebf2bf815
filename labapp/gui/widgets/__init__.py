"""Fields, labels and tables that the pages are made of."""

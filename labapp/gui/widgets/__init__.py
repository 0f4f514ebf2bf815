"""Fields, labels and tables of the pages."""

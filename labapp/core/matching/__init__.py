"""Correspondence of rays and reflected dots, and its reliability."""

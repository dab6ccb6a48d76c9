"""Tolerance analysis: effects of fabrication errors on spots and depths, and the yield."""

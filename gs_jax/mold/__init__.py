"""Molds: a design as a solid, checked before and measured after."""

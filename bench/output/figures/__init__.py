"""Figures for print, as PDF and PNG."""

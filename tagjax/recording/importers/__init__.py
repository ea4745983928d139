"""Importers: foreign formats to recordings."""

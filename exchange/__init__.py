"""Import and export of other projects' formats: importers return postures in graspd's frames."""

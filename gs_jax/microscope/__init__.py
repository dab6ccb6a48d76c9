"""The microscope: lenses, media, sensor and voxels, layouts, and where a lens images a point."""

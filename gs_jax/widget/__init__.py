"""napari plugin: a dock widget, and a sample capture."""

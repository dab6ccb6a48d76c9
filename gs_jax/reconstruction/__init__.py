"""From a capture to a volume, whatever the method."""

"""What a microscope is, as a file and as a judgement of it."""

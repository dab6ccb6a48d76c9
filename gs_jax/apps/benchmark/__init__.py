"""Methods compared: time, memory and quality (Fig. 9)."""

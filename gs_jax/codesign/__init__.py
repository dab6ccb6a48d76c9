"""Co-design: studies, their terms, and searches for better microscopes."""

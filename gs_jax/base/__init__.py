"""What everything stands on: errors, progress, numbers that stay finite, and what the machine is."""

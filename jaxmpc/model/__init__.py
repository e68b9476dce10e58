"""What a process does: step-response models (2.29)-(2.31)."""

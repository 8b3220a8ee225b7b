"""What a run found, missed or reported falsely."""

"""What a whole-body controller is worth: tracking, balance, reach, and how peers do."""

"""Templates of dataset cards, installed as ``lerobot_demohlm.dataset_cards``."""

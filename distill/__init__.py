"""Students: training set, LoRA training, inference and evaluation."""

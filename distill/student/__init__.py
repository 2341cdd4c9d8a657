"""The model, its tokenizer and image processor, samples as tensors, what training leaves on disk."""

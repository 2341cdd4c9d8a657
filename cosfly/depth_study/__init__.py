"""What each way to store depth costs, measured on one frame: `cosfly depth-study` (app:depth)."""

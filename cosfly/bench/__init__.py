"""What a stage does on this machine with more workers, and with workers that die and stall: `cosfly bench`."""

"""MuCO: one trajectory, optimised as a whole."""

"""Scores beside their floors."""

"""The stage: captions of all windows of all tracks, counted and resumable."""

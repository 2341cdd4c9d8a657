"""The stage: all windows of all flights, counted, shown and resumable."""

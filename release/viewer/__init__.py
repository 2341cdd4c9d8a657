"""One page that shows a release or a run: flights, frames, maps, captions."""

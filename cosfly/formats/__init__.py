"""What stages exchange on disk: one module for each file, with its type, its one reader and its one writer."""

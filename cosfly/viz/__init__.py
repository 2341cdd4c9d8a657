"""Pictures and pages that several stages draw."""

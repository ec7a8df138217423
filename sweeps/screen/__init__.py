"""What a sweep shows in a terminal: a table of its runs, and lines on what is new."""

"""Tables, figures and texts written into the results folder."""

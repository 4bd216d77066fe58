"""Tables to trajectories and back: the measurements, their inputs and doses, and the cases that describe them."""

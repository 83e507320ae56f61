//! Text to values and back: camera files and trajectories.

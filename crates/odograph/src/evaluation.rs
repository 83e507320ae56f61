//! How good a trajectory is: absolute and relative errors, drift per metre.

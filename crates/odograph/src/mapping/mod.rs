//! Subsystem 7: the movement map in metres: the drawn path and the mosaic of the ground.

//! Rendered ground with exact truth, for tests, demos and measurements.

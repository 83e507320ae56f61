//! The program `odograph`.

fn main() {}

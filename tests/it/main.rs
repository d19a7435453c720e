//! Tests from outside: the laws of the house, the server over real sockets, the trainer as a process.

// A test that panics has failed, which is what an unwrap here is for.
#![allow(clippy::unwrap_used)]

mod allocations;
mod golden;
mod laws;
mod protocol;
mod server;
mod trainer;

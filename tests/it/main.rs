//! Tests from outside: the laws of the house, the server over real sockets, the trainer as a process.

mod laws;
mod server;
mod trainer;

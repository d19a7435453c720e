//! Tests from outside: the laws of the house, and the server over real sockets.

mod laws;
mod server;

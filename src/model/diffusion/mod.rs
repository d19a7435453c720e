//! Stage 2: the diffusion process with a level per position, its schedule, a window's way down, and the loss (sections 4.1, 4.3, 4.4 of
//! the paper).
pub mod descent;
mod hurry;
pub mod process;
pub mod refine;
pub mod schedule;

//! Stage 2: the diffusion process with a level per position, its schedule, a window's way down, and the loss (sections 4.1, 4.3, 4.4 of
//! the paper).
mod at_once;
pub mod descent;
pub mod draw;
pub mod guidance;
mod hurry;
pub mod inverse;
pub mod picard;
pub mod process;
pub mod refine;
pub mod schedule;

//! Stage 2: the diffusion process with a level per position, the ladder, and the refinement (sections 4.1, 4.3, 4.4 of the paper).
pub mod ladder;
pub mod process;
pub mod refine;

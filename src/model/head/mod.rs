//! From a plan to actions.
mod inverse;
mod skill;

pub use inverse::InverseDynamics;
pub use skill::{Segments, SkillTerms, Skills};

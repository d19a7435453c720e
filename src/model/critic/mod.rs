//! What a window or an action is worth, so that a sampler can be led to better ones (Janner et al. 2022, section 3.3), or choose.
mod double;
mod twin;
mod value;

pub use crate::model::temporal::Given;
pub use double::SkillTransitions;
pub use twin::{Critic, CriticTerms, Judged, Transitions};
pub use value::{Sizes, Value, check_value};

#[cfg(test)]
mod tests;

//! Inverse dynamics: the action that leads from one state to the next (Ajay et al. 2022; the paper's planner of type (ii), algorithm 3).
//!
//! As an MLP it gives one answer. As a diffusion of the action alone (10 levels in the paper's appendix) it gives one of those that the data
//! have; it is trained to tell the clean action, since actions have bounds.

use crate::model::{
    method::{Head, Inverse, Method},
    nn::{
        Activation::{Mish, Relu},
        Activations, Linear,
        params::Params,
        time_embedding::Sinusoid,
    },
    trajectory::Layout,
};
use candle_core::Result;

/// Channels of the embedding of a level, and its hidden width (CleanDiffuser's sizes).
const LEVEL_CHANNELS: usize = 64;
const LEVEL_HIDDEN: usize = 128;

/// See the module.
pub struct InverseDynamics {
    net: Net,
    sees_latent: bool,
}

enum Net {
    Mlp(Box<[Linear; 3]>),
    Diffusion(Box<Denoiser>),
}

/// A diffusion over one action.
struct Denoiser {
    sinusoid: Sinusoid,
    time: [Linear; 2],
    layers: [Linear; 4],
}

impl InverseDynamics {
    /// Networks under `params`' scope; none where actions are part of the plan.
    ///
    /// # Errors
    /// If a loaded parameter is missing or of another shape.
    pub fn new(layout: Layout, method: &Method, params: &Params) -> Result<Option<Self>> {
        let Head::Inverse { network, latent } = &method.head else { return Ok(None) };
        let given = 2 * layout.state_dim + if *latent { method.latent.dim() } else { 0 };
        let net = match network {
            Inverse::Mlp { width } => Net::Mlp(Box::new([
                Linear::new(given, *width, &params.scope(0))?,
                Linear::new(*width, *width, &params.scope(2))?,
                Linear::new(*width, layout.action_dim, &params.scope(4))?,
            ])),
            Inverse::Diffusion { width, steps } => Net::Diffusion(Box::new(Denoiser {
                sinusoid: Sinusoid::new(LEVEL_CHANNELS, *steps)?,
                time: [
                    Linear::new(LEVEL_CHANNELS, LEVEL_HIDDEN, &params.scope("time.0"))?,
                    Linear::new(LEVEL_HIDDEN, LEVEL_CHANNELS, &params.scope("time.2"))?,
                ],
                layers: [
                    Linear::new(layout.action_dim + LEVEL_CHANNELS + given, *width, &params.scope(0))?,
                    Linear::new(*width, *width, &params.scope(2))?,
                    Linear::new(*width, *width, &params.scope(4))?,
                    Linear::new(*width, layout.action_dim, &params.scope(6))?,
                ],
            })),
        };
        Ok(Some(Self { net, sees_latent: *latent }))
    }

    /// Whether it is given the latent of the step.
    pub fn sees_latent(&self) -> bool {
        self.sees_latent
    }

    /// The clean actions `(B, N, action_dim)` from states before and after side by side, `(B, N, 2 state_dim)`, and latents `(B, N, dim)`, if it
    /// sees them. As a diffusion it is given the noisy actions, `(B, N, action_dim)`, and their levels, `B * N`.
    ///
    /// # Errors
    /// If a shape differs, or something that it needs is missing.
    pub fn predict<V: Activations>(&self, states: &V, latents: Option<&V>, noisy: Option<(&V, &[f32])>) -> Result<V> {
        let joined = match (self.sees_latent, latents) {
            (true, Some(latents)) => Some(V::beside(&[states, latents])?),
            (true, None) => candle_core::bail!("these inverse dynamics need the latent"),
            (false, _) => None,
        };
        let given = joined.as_ref().unwrap_or(states);
        match (&self.net, noisy) {
            (Net::Mlp(layers), _) => {
                let [first, second, last] = &**layers;
                let h = first.forward(given)?.activated(Relu)?;
                last.forward(&second.forward(&h)?.activated(Relu)?)
            }
            (Net::Diffusion(net), Some((noisy, levels))) => net.predict(given, noisy, levels),
            (Net::Diffusion(_), None) => candle_core::bail!("these inverse dynamics need noisy actions"),
        }
    }
}

impl Denoiser {
    fn predict<V: Activations>(&self, given: &V, noisy: &V, levels: &[f32]) -> Result<V> {
        let [batch, steps, _] = noisy.shape()?;
        let level = V::generate([batch, steps, LEVEL_CHANNELS], |out| {
            levels.iter().zip(out.chunks_exact_mut(LEVEL_CHANNELS)).for_each(|(level, out)| self.sinusoid.write(*level, out));
        })?;
        let level = self.time[1].forward(&self.time[0].forward(&level)?.activated(Mish)?)?;
        let [hidden @ .., last] = &self.layers;
        let mut h = V::beside(&[noisy, &level, given])?;
        for layer in hidden {
            h = layer.forward(&h)?.activated(Mish)?;
        }
        last.forward(&h)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{
        config::ModelConfig,
        golden::Golden,
        method::{Backbone, Diffused, GruLatent, Looks},
        nn::Buffer,
    };

    fn method(network: Inverse, latent: bool) -> Method {
        let layout = Layout { state_dim: 3, action_dim: 2 };
        let gru = latent.then(|| GruLatent::plain(4, 8, Looks::Block(2)));
        let mut method = ModelConfig::plain(layout, gru, Backbone::dit(4, 1, 1)).method;
        (method.plan.diffused, method.head) = (Diffused::State, Head::Inverse { network, latent });
        method
    }

    /// Both kinds, given a latent and none: results and all gradients, as PyTorch computes them.
    #[test]
    fn inverse_dynamics_against_pytorch() {
        let layout = Layout { state_dim: 3, action_dim: 2 };
        let build = |method: &Method, params: &Params| InverseDynamics::new(layout, method, params).map(Option::unwrap);
        let (golden, mlp) = (Golden::of("inverse"), method(Inverse::Mlp { width: 7 }, true));
        golden.check_training(|given, params| {
            Ok(vec![("action".into(), build(&mlp, params)?.predict(&given["state"], given.get("latents"), None)?)])
        });
        let [states, latents]: [Buffer; 2] = ["in.state", "in.latents"].map(|name| golden.value(name));
        golden.check_serving(|params| Ok(vec![("action".into(), build(&mlp, params)?.predict(&states, Some(&latents), None)?)]));
        let (golden, noisy) = (Golden::of("noisy_inverse"), method(Inverse::Diffusion { width: 7, steps: 10 }, false));
        let levels = golden.flat("in.levels");
        golden.check_training(|given, params| {
            Ok(vec![("action".into(), build(&noisy, params)?.predict(&given["state"], None, Some((&given["noise"], &levels)))?)])
        });
        let [states, noise]: [Buffer; 2] = ["in.state", "in.noise"].map(|name| golden.value(name));
        golden.check_serving(|params| Ok(vec![("action".into(), build(&noisy, params)?.predict(&states, None, Some((&noise, &levels)))?)]));
    }
}

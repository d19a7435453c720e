//! Ada-Diffuser: infer a hidden context from a few time steps, and let a causal diffusion model plan with it.
//!
//! # The map
//! | room | what | start at |
//! |---|---|---|
//! | [`model`] | what Ada-Diffuser is: tensors in, tensors out | [`model::agent::Agent`] |
//! | [`train`] | how checkpoints are made from recorded rollouts | [`train::recipe`] |
//! | [`serve`] | how checkpoints are used: gRPC and REST | [`serve::service`] |
//!
//! ([`restart`], at the door of both programs, sees to the environment that their libraries read.)
//!
//! ```text
//! bin/server -> serve -> model <- train <- bin/trainer        serve and train never meet
//! model: fit, method, noise, options, trajectory <- normalizer <- nn <- temporal <- {latent | denoiser | critic | head} <- config, networks
//!        <- columns <- diffusion <- agent <- checkpoint
//! (x <- y: y may use x; in braces: never each other; check, the one check of a model, stands apart)
//! ```
//! Only `model` and `train` know candle; only `serve` knows tokio, tonic, axum and the clock; tests in `tests/it` read the source and hold
//! these borders.
//!
//! # One request, followed by hand
//! 1. Bytes arrive at [`serve::listener`], if their connection has a place ([`serve::connections`]) and the request may come from where it
//!    says ([`serve::guard`]); [`serve::grpc`] or [`serve::http`] turns them into a request of the core and checks them.
//! 2. `serve/keeper.rs` finds the session, in memory or in the [`serve::store`] behind it; [`serve::session`] compares the step with the committed
//!    one: a retry is answered from memory, a wrong step refused; otherwise the episode, an immutable value ([`model::agent::Episode`]), is leased.
//! 3. [`model::agent::Agent::begin`] checks the observation and makes a [`model::agent::Act`]: a small program that asks networks
//!    ([`model::agent::Ask`]) while its window goes down the table of noise levels ([`model::diffusion::schedule`]).
//! 4. [`serve::engine`], earliest deadline first, calls [`model::agent::Agent::advance`] on all acts in flight: what they ask is answered
//!    together, with one forward of the denoiser a tick, on pooled memory. An act that would come too late takes larger jumps. The latent is
//!    inferred from what was really seen ([`model::latent`], by the same [`model::latent::Evidence`] as in training), refined at rung 1 by the
//!    window itself (zig-zag), and the denoiser ([`model::denoiser`]) takes every window one row down ([`model::diffusion::descent`]), led by a guide
//!    where it is asked to be ([`model::diffusion::guidance`]). Of a plan of states inverse dynamics ([`model::head`]) make actions.
//! 5. A finished act is a new episode and a [`model::agent::Chunk`]; the session commits both together, if the step is still the
//!    same: into the store, where there is one, then in memory. Then the answer goes out. Where acts are recorded ([`serve::recording`]) it is noted at
//!    the commit, and written by a thread of its own.
//!
//! What a model is stands in one struct, [`model::method::Method`], word for word the same in a recipe and in a checkpoint; each choice is a
//! closed enum. [`model::check`] is the one check of it, for recipes, checkpoints and sessions.
//!
//! Networks are written once, over any [`model::nn::Activations`]: [`model::nn::Buffer`]s here, [`model::nn::Traced`] where a sampler needs a
//! gradient, candle's tensors in training.
//!
//! Training is the mirror: recipe -> data set -> its stages, each a sum of losses ([`model::latent::elbo`], [`model::diffusion::refine`]) ->
//! [`model::checkpoint`]. Losses live beside the networks they train; [`train`] turns the crank.
//!
//! # Where is ...
//! | what | where |
//! |---|---|
//! | a choice of a method, and what may go with what | [`model::method`], [`model::check`] |
//! | the noise schedule: which position stands at which level after so many evaluations | [`model::diffusion::schedule::Table`] |
//! | the forward process (`q_sample`), a step of the sampler | [`model::diffusion::process`], [`model::diffusion::descent`] |
//! | a latent inferred from tokens, told by the prior, refined | [`model::latent::Encoder`], [`model::latent::Prior`], `model/agent/answers.rs` |
//! | what is known of the present and the future when it is | [`model::latent::Evidence`] |
//! | another method of the paper, or of those that it is compared with | `models/methods/`, `docs/methods.md`, [`train::recipe::Changes`] |
//! | a second window for an act (candidates, classifier-free guidance) | [`model::agent::Act::rows`], `model/agent/candidate.rs`, `rows.rs` |
//! | several rows of the table at once (Picard iteration) | [`model::diffusion::picard`] |
//! | what a window is worth, and the way to better ones | [`model::critic::Value`], [`model::diffusion::guidance`], [`model::nn::gradient()`] |
//! | actions of a plan of states | [`model::head::InverseDynamics`], [`model::diffusion::inverse`] |
//! | a skill: what its code stands for, and what it is worth | [`model::head::Skills`], [`model::critic::SkillTransitions`] |
//! | blocks that networks over windows share | [`model::temporal`] |
//! | a layer: its shape, forward and backward | [`model::nn`], `op.rs` and one file a layer; loops in `kernels` |
//! | what the latent found of the context, and what there was to find | [`train::probe`], `docs/identification.md` |
//! | what is minimized, and which networks move | [`train::recipe::stages`], [`train::recipe::losses`] |
//! | which episodes a loss draws from; a batch cut from them, over the border of a session too | [`train::dataset::Which`], [`train::dataset::window`] |
//! | what was executed, as tokens; a history that outlasts an episode, or is brought along | `model/agent/executed.rs`, [`model::agent::Agent::recall`] |
//! | a restart of a window that is not trusted | `model/agent/restart.rs` |
//! | a session as bytes; an episode that was written down, taken up again | [`serve::session::Record`], [`model::agent::Agent::adopt`] |
//! | a session that outlives the process: what is written, when, and where | `serve/session/keeping.rs`, `serve/keeper.rs`, [`serve::store`] |
//! | the whole server in a simulated world, and what it needs of a network, a disk and a clock | `examples/simulate`, [`serve::net`], [`serve::service::Service::by_hand`] |
//! | the points at which those who share a session may overtake one another | `serve/session/lock.rs`, `interleaving_tests.rs` |
//! | an act that panics, a number that is not finite, a thread that hangs; all of them on demand | [`serve::engine`] (`worker.rs`, `pulse.rs`), `serve/session/poison.rs`, [`model::agent::Place`], [`serve::fault`] |
//! | an act that was recorded, and how it is done again | [`serve::recording`], [`serve::replay`], [`model::agent::Haste`] |
//! | an option of a session, from the wire to the sampler | [`serve::options`], [`model::options`] |
//!
//! # Paper and code
//! Two clocks, two letters: `t` is environment time, `k` is noise level.
//!
//! | paper | code | paper | code |
//! |---|---|---|---|
//! | K | `level_max` | T_o | `obs_horizon` |
//! | k_i | `level`, `levels` | T_p | `horizon` (on the wire `plan_horizon`) |
//! | abar_k | `alpha_bar` | T_a | `action_horizon` |
//! | eps_theta | [`model::denoiser::Denoiser::predict`] (x0, if [`model::method::Target`] says so) | T_x | `block_len`, [`model::method::Looks`] |
//! | c_t | `latent`, `latents` | x_t | [`model::trajectory::Token`], columns by [`model::columns::Columns`] |
//! | p_phi, q_psi, p(x given x, c) | [`model::latent::Prior`], [`model::latent::Encoder`], [`model::latent::Decoder`] | zig-zag | `kappa` |
//! | omega | `guidance_scale` | R_hat, y | `told_return`, `told_goal` |
#![warn(missing_docs)]
pub mod model;
pub mod restart;
pub mod serve;
pub mod train;

//! The one check of what a model is and how it may be sampled: recipes before training, checkpoints as they are loaded, and sessions as they
//! are opened all ask here, so that what one of them takes, the others take as well.

use crate::model::{
    Networks,
    config::{ModelConfig, Restart, Units},
    denoiser,
    diffusion::schedule::Table,
    fit::{Unfit, WIDTH_MAX, require, size},
    method::{Baseline, Diffusion, Future, GruLatent, Looks, Method, Schedule},
    nn::{params::Params, plain},
    options::SamplerOptions,
    trajectory::Layout,
};

/// Generated positions of a window.
const HORIZON_MAX: usize = 1024;
/// Real steps that a network looks back on.
const HISTORY_MAX: usize = 4096;
/// Diffusion levels; each costs memory in every loaded model.
const LEVEL_MAX_MAX: usize = 1 << 20;
/// State or action columns; `config.json` lists several numbers for each.
const COLUMNS_MAX: usize = 4096;
/// Numbers in all networks, and tensors that hold them: within the loader's bounds on the weight file and the manifest.
const PARAMETERS_MAX: usize = 1 << 27;
const TENSORS_MAX: usize = 2048;
/// Factor on the noise.
const TEMPERATURE_MAX: f32 = 10.0;

impl ModelConfig {
    /// Whether this is a model: sizes, units, restarts and sampling defaults.
    ///
    /// # Errors
    /// The first field that does not fit.
    pub fn check(&self) -> Result<(), Unfit> {
        self.check_sizes()?;
        self.units.check(self.layout)?;
        let Restart { renoise_distance, cold_distance, latent_jump, latent_kl } = self.defaults.restart;
        for (field, value) in [
            ("renoise_distance", renoise_distance),
            ("cold_distance", cold_distance),
            ("latent_jump", latent_jump),
            ("latent_kl", latent_kl),
        ] {
            require(value >= 0.0, format!("defaults.restart.{field}"), format!("is {value}, must be 0 or above (inf: never)"))?;
        }
        let sampler = |(field, reason)| Unfit { field: format!("defaults.sampler.{field}"), reason };
        self.check_options(&self.defaults.sampler).map_err(sampler)?;
        self.check_parameters()
    }

    /// Whether a session may ask for these options. Sub-steps are those of training: a network that has seen no levels
    /// between the rungs is lost there (measured on Point-Wind-S: -21 becomes -119 with 2 sub-steps instead of 1). So are the actions of a
    /// chunk: one that never saw a window begin at an imagined state drifts off (-20 becomes -33 with 2 actions instead of 1).
    ///
    /// # Errors
    /// The field of [`SamplerOptions`], and what is wrong and what is allowed.
    pub fn check_options(&self, options: &SamplerOptions) -> Result<(), (&'static str, String)> {
        let horizon = self.method.plan.horizon;
        let holds = |holds: bool, field, reason: &dyn Fn() -> String| if holds { Ok(()) } else { Err((field, reason())) };
        let SamplerOptions { streaming, action_horizon, sub_steps, eta, temperature, kappa, latent: _ } = options;
        holds((1..=horizon).contains(action_horizon), "action_horizon", &|| format!("{action_horizon} is outside 1..={horizon}"))?;
        Table::new(self.method.plan.schedule, horizon, *sub_steps, self.method.plan.level_max).map_err(|reason| ("sub_steps", reason))?;
        let trained = &self.trained;
        holds(trained.sub_steps.contains(sub_steps), "sub_steps", &|| {
            format!("this checkpoint was trained for the levels of {:?} sub-steps a rung, not {sub_steps}", trained.sub_steps)
        })?;
        holds(trained.action_horizons.contains(action_horizon), "action_horizon", &|| {
            format!("this checkpoint was trained for chunks of {:?} actions, not {action_horizon}", trained.action_horizons)
        })?;
        holds(!streaming || self.method.plan.schedule == Schedule::Ladder, "streaming", &|| {
            "only a ladder leaves a window for the next act: positions come clean one after the other there; only false is allowed".into()
        })?;
        holds((0.0..=1.0).contains(eta), "eta", &|| format!("{eta} is outside 0..=1"))?;
        let warm = (0.0..=TEMPERATURE_MAX).contains(temperature);
        holds(warm, "temperature", &|| format!("{temperature} is outside 0..={TEMPERATURE_MAX}"))?;
        holds(*kappa >= 0.0, "kappa", &|| format!("{kappa} is not 0 (off) or above"))?;
        holds(*kappa == 0.0 || self.method.latent.gru().is_none() || trained.refined, "kappa", &|| {
            "this checkpoint was not trained with refinement, and zig-zag would harm it; only 0 is allowed".into()
        })
    }

    fn check_sizes(&self) -> Result<(), Unfit> {
        size("layout.state_dim", self.layout.state_dim, COLUMNS_MAX)?;
        size("layout.action_dim", self.layout.action_dim, COLUMNS_MAX)?;
        let Method { latent, plan } = &self.method;
        let Diffusion { horizon, obs_horizon, level_max, schedule, backbone: _, clip } = plan;
        size("method.plan.horizon", *horizon, HORIZON_MAX)?;
        size("method.plan.obs_horizon", *obs_horizon, HISTORY_MAX)?;
        size("method.plan.level_max", *level_max, LEVEL_MAX_MAX)?;
        match schedule {
            Schedule::Ladder => {}
            Schedule::Uniform { steps } => size("method.plan.schedule.steps", *steps, *level_max)?,
        }
        if let Some(gru) = latent.gru() {
            let GruLatent { dim, hidden, looks: _, future, stays, baseline, tells, actions: _ } = gru;
            size("method.latent.dim", *dim, WIDTH_MAX)?;
            size("method.latent.hidden", *hidden, WIDTH_MAX)?;
            if let Some(Baseline { width }) = baseline {
                size("method.latent.baseline.width", *width, WIDTH_MAX)?;
            }
            require(*tells <= COLUMNS_MAX, "method.latent.tells", format!("is {tells}, at most {COLUMNS_MAX} are allowed"))?;
            let moves = *future == Future::Held || *stays < *dim;
            require(
                *stays <= *dim && moves,
                "method.latent.stays",
                format!("is {stays}, must be below dim ({dim}), or dim where future = held"),
            )?;
            match gru.looks {
                Looks::Block(len) => size("method.latent.looks", len, HISTORY_MAX)?,
                Looks::Running => {
                    let reason = "running takes chunks of one action, or future = held: its memory holds real steps alone, and a refinement \
                                  within a chunk would look back on imagined ones";
                    let alone = self.trained.action_horizons == [1] || !self.trained.refined;
                    require(gru.future == Future::Held || alone, "method.latent.looks", reason)?;
                }
            }
        }
        denoiser::check(plan)?;
        require(clip.is_finite() && *clip > 0.0, "method.plan.clip", format!("is {clip}, must be positive and finite"))
    }

    fn check_parameters(&self) -> Result<(), Unfit> {
        let params = Params::counted();
        let built = Networks::new(self.layout, &self.method, &params);
        built.map_err(|error| Unfit { field: "method".into(), reason: plain(&error) })?;
        let (tensors, parameters) = params.count();
        let fits = tensors <= TENSORS_MAX && parameters <= PARAMETERS_MAX;
        let reason = format!(
            "the networks would have {parameters} parameters in {tensors} tensors, at most {PARAMETERS_MAX} in {TENSORS_MAX} are allowed"
        );
        require(fits, "method", reason)
    }
}

impl Units {
    fn check(&self, Layout { state_dim: state, action_dim: action }: Layout) -> Result<(), Unfit> {
        let units = &self.normalizer;
        for (field, affine, width) in [("state", &units.state, state), ("action", &units.action, action), ("reward", &units.reward, 1)] {
            let field = format!("units.normalizer.{field}");
            columns(&field, affine.dim(), width)?;
            columns(&format!("{field}.std"), affine.std.len(), width)?;
            require(affine.std.iter().all(|std| std.is_normal() && *std > 0.0), &field, "a scale is zero, negative or not finite")?;
            require(affine.mean.iter().all(|mean| mean.is_finite()), &field, "a mean is not finite")?;
        }
        columns("units.normalizer.state_change_std", units.state_change_std.len(), state)?;
        let changes = units.state_change_std.iter().all(|std| std.is_finite());
        require(changes, "units.normalizer.state_change_std", "a value is not finite")?;
        columns("units.action_low", self.action_low.len(), action)?;
        columns("units.action_high", self.action_high.len(), action)?;
        let bounded = |(low, high): (&f32, &f32)| low <= high && low.is_finite() && high.is_finite();
        let bounds = self.action_low.iter().zip(&self.action_high);
        require(bounds.into_iter().all(bounded), "units.action_low", "must not be above action_high, and both finite")?;
        let spread = self.latent_spread;
        require(spread.is_finite() && spread >= 0.0, "units.latent_spread", format!("is {spread}, must be 0 or above"))
    }
}

fn columns(field: &str, found: usize, expected: usize) -> Result<(), Unfit> {
    require(found == expected, field, format!("has {found} columns, expected {expected}"))
}

//! The one check of what a model is and how it may be sampled: recipes before training, checkpoints as they are loaded, and sessions as they
//! are opened all ask here, so that what one of them takes, the others take as well.

use crate::model::{
    Networks,
    config::{ModelConfig, Restart, Units},
    critic::check_value,
    denoiser,
    diffusion::schedule::Table,
    fit::{Unfit, WIDTH_MAX, require, size},
    method::{Baseline, Diffused, Diffusion, Future, GruLatent, Guide, Head, Inverse, LatentSource, Looks, Method, Schedule, Told},
    nn::{params::Params, plain},
    normalizer::Affine,
    options::{LatentMode, SamplerOptions},
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
/// Layers of an encoder of skills.
const LAYERS_MAX: usize = 64;
/// Evaluations of inverse dynamics for one action.
const INVERSE_STEPS_MAX: usize = 1000;
/// Factor on the noise.
const TEMPERATURE_MAX: f32 = 10.0;

/// Factor on a guide's gradient, or on what is told.
const SCALE_MAX: f32 = 1000.0;
/// Futures of Monte Carlo guidance.
const SAMPLES_MAX: usize = 64;
/// Windows of one act, and rows that it may have in one evaluation.
const CANDIDATES_MAX: usize = 1024;
const ROWS_MAX: usize = 4096;

/// The field of [`SamplerOptions`] that does not fit, and why.
type Wrong = (&'static str, String);

fn holds(holds: bool, field: &'static str, reason: &dyn Fn() -> String) -> Result<(), Wrong> {
    if holds { Ok(()) } else { Err((field, reason())) }
}

/// Rows of one act in an evaluation.
fn check_rows(options: &SamplerOptions) -> Result<(), Wrong> {
    let SamplerOptions { picard_window, picard_tolerance, .. } = options;
    let window = (1..=ROWS_MAX).contains(picard_window);
    holds(window, "picard_window", &|| format!("{picard_window} is outside 1..={ROWS_MAX}"))?;
    let bound = picard_tolerance.is_finite() && *picard_tolerance >= 0.0;
    holds(bound, "picard_tolerance", &|| format!("{picard_tolerance} is not 0 or above"))?;
    let rows = options.rows_max();
    holds(rows <= ROWS_MAX, "candidates", &|| {
        format!("with picard_window and what is told an act would have {rows} rows, at most {ROWS_MAX} are allowed")
    })
}

impl ModelConfig {
    /// Whether this is a model: sizes, units, restarts and sampling defaults.
    ///
    /// # Errors
    /// The first field that does not fit.
    pub fn check(&self) -> Result<(), Unfit> {
        self.check_sizes()?;
        self.units.check(self.layout)?;
        let context = self.units.context.as_ref().map_or(0, Affine::dim);
        let told = self.method.latent.truth().map_or(0, |(dim, _)| dim);
        columns("units.context", context, told)?;
        columns("units.returns", self.units.returns.as_ref().map_or(0, Affine::dim), usize::from(self.method.asks_for_returns()))?;
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
    pub fn check_options(&self, options: &SamplerOptions) -> Result<(), Wrong> {
        let plan = &self.method.plan;
        // An action that leads to a state needs that state.
        let most = plan.horizon - plan.diffused.first_free();
        let SamplerOptions { streaming, action_horizon, sub_steps, eta, temperature, kappa, latent, .. } = options;
        holds((1..=most).contains(action_horizon), "action_horizon", &|| format!("{action_horizon} is outside 1..={most}"))?;
        Table::of(plan, *sub_steps).map_err(|reason| ("sub_steps", reason))?;
        let trained = &self.trained;
        holds(trained.sub_steps.contains(sub_steps), "sub_steps", &|| {
            format!("this checkpoint was trained for the levels of {:?} sub-steps a rung, not {sub_steps}", trained.sub_steps)
        })?;
        holds(trained.action_horizons.contains(action_horizon), "action_horizon", &|| {
            format!("this checkpoint was trained for chunks of {:?} actions, not {action_horizon}", trained.action_horizons)
        })?;
        holds(!streaming || plan.schedule.is_ladder(), "streaming", &|| {
            "only a ladder leaves a window for the next act: positions come clean one after the other there; only false is allowed".into()
        })?;
        holds((0.0..=1.0).contains(eta), "eta", &|| format!("{eta} is outside 0..=1"))?;
        let warm = (0.0..=TEMPERATURE_MAX).contains(temperature);
        holds(warm, "temperature", &|| format!("{temperature} is outside 0..={TEMPERATURE_MAX}"))?;
        holds(*kappa >= 0.0, "kappa", &|| format!("{kappa} is not 0 (off) or above"))?;
        holds(*kappa == 0.0 || self.method.latent.gru().is_none() || trained.refined, "kappa", &|| {
            "this checkpoint was not trained with refinement, and zig-zag would harm it; only 0 is allowed".into()
        })?;
        holds(*latent == LatentMode::Mean || self.method.latent.truth().is_none(), "latent", &|| {
            "the true context has no spread to draw from; only mean is allowed".into()
        })?;
        self.check_guidance(options)?;
        self.check_told(options)?;
        check_rows(options)
    }

    /// What leads a window, and what chooses among several.
    fn check_guidance(&self, options: &SamplerOptions) -> Result<(), Wrong> {
        let SamplerOptions { streaming, guidance_scale, guidance_samples, candidates, pick_temperature, .. } = options;
        let (guided, leads) = (self.method.guide.is_some(), self.method.guide.as_ref().is_some_and(Guide::leads));
        let scale = (0.0..=SCALE_MAX).contains(guidance_scale);
        holds(scale, "guidance_scale", &|| format!("{guidance_scale} is outside 0..={SCALE_MAX}"))?;
        let untrained = || "this checkpoint has no guide (`model.guide` of a recipe)".to_string();
        holds(guided || *guidance_scale == 0.0, "guidance_scale", &|| format!("{}; only 0 is allowed", untrained()))?;
        holds(leads || *guidance_scale == 0.0, "guidance_scale", &|| {
            "this checkpoint's critic chooses among candidates and leads none; only 0 is allowed".into()
        })?;
        let samples = *guidance_samples <= SAMPLES_MAX;
        holds(samples, "guidance_samples", &|| format!("{guidance_samples} is outside 0..={SAMPLES_MAX}"))?;
        holds(*guidance_samples == 0 || *guidance_scale > 0.0, "guidance_samples", &|| "needs a guidance_scale above 0".into())?;
        let count = (1..=CANDIDATES_MAX).contains(candidates);
        holds(count, "candidates", &|| format!("{candidates} is outside 1..={CANDIDATES_MAX}"))?;
        holds(guided || *candidates == 1, "candidates", &|| format!("{}, so nothing could choose; only 1 is allowed", untrained()))?;
        holds(!streaming || *candidates == 1, "candidates", &|| {
            "a window that is kept for the next act is one alone: several candidates need streaming = false".into()
        })?;
        let warm = (0.0..=TEMPERATURE_MAX).contains(pick_temperature);
        holds(warm, "pick_temperature", &|| format!("{pick_temperature} is outside 0..={TEMPERATURE_MAX}"))
    }

    /// What a session tells of its wishes: all that the model takes, or nothing.
    fn check_told(&self, options: &SamplerOptions) -> Result<(), Wrong> {
        let SamplerOptions { free_guidance_scale, told_return, told_goal, .. } = options;
        let takes = |told: fn(&Told) -> bool| self.method.told.iter().find(|&kind| told(kind));
        let (wants_return, goal) = (takes(|told| *told == Told::Return), takes(|told| matches!(told, Told::Goal { .. })));
        let untrained = |what: &str| format!("this checkpoint was not trained to be told {what} (`model.told` of a recipe)");
        holds(told_return.is_none() || wants_return.is_some(), "told_return", &|| untrained("a return"))?;
        holds(told_goal.is_none() || goal.is_some(), "told_goal", &|| untrained("a goal"))?;
        holds(told_return.is_none_or(f32::is_finite), "told_return", &|| "is not a finite number".into())?;
        if let (Some(values), Some(kind)) = (told_goal, goal) {
            let width = kind.width();
            holds(values.len() == width, "told_goal", &|| format!("has {} values, the model takes {width}", values.len()))?;
            holds(values.iter().all(|value| value.is_finite()), "told_goal", &|| "a value is not a finite number".into())?;
        }
        let tells = told_return.is_some() || told_goal.is_some();
        let partly = |told: bool, takes: bool| tells && takes && !told;
        let all = || "is missing: this checkpoint was trained to be told all that it takes, or nothing".into();
        holds(!partly(told_return.is_some(), wants_return.is_some()), "told_return", &all)?;
        holds(!partly(told_goal.is_some(), goal.is_some()), "told_goal", &all)?;
        let scale = (0.0..=SCALE_MAX).contains(free_guidance_scale);
        holds(scale, "free_guidance_scale", &|| format!("{free_guidance_scale} is outside 0..={SCALE_MAX}"))?;
        holds(*free_guidance_scale == 1.0 || tells, "free_guidance_scale", &|| {
            "nothing is told (told_return, told_goal), so there is nothing to go beyond; only 1 is allowed".into()
        })
    }

    fn check_sizes(&self) -> Result<(), Unfit> {
        size("layout.state_dim", self.layout.state_dim, COLUMNS_MAX)?;
        size("layout.action_dim", self.layout.action_dim, COLUMNS_MAX)?;
        let Method { latent, plan, head, guide, told, discount } = &self.method;
        let Diffusion { horizon, obs_horizon, level_max, alpha: _, diffused, target: _, schedule, backbone: _, clip } = plan;
        size("method.plan.horizon", *horizon, HORIZON_MAX)?;
        size("method.plan.obs_horizon", *obs_horizon, HISTORY_MAX)?;
        size("method.plan.level_max", *level_max, LEVEL_MAX_MAX)?;
        match schedule {
            Schedule::Ladder { map: _ } => {}
            Schedule::Uniform { steps } => size("method.plan.schedule.steps", *steps, *level_max)?,
        }
        check_head(*diffused, head, latent)?;
        self.check_code(*diffused)?;
        check_guide(guide.as_ref(), plan, latent)?;
        self.check_kinds_told(told)?;
        require((0.0..1.0).contains(discount), "method.discount", format!("is {discount}, must lie in 0..1"))?;
        if let Some((dim, _)) = latent.truth() {
            size("method.latent.dim", dim, COLUMNS_MAX)?;
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
        let held = latent.gru().is_some() && !self.method.can_refine() && schedule.is_ladder();
        let single = *diffused != Diffused::Action || !held || self.trained.action_horizons == [1];
        let reason = "of a policy on a ladder whose belief is held must be [1]: the belief of a later action would be one without a state";
        require(single, "trained.action_horizons", reason)?;
        denoiser::check(plan)?;
        require(clip.is_finite() && *clip > 0.0, "method.plan.clip", format!("is {clip}, must be positive and finite"))
    }

    /// A code is a window of one position, and what is done by it is asked state by state.
    fn check_code(&self, diffused: Diffused) -> Result<(), Unfit> {
        if diffused.code_steps().is_none() {
            return Ok(());
        }
        let Diffusion { horizon, schedule, .. } = &self.method.plan;
        require(
            *horizon == 1,
            "method.plan.horizon",
            format!("is {horizon}, must be 1 where a code is diffused, which is one for all steps"),
        )?;
        require(
            !schedule.is_ladder(),
            "method.plan.schedule",
            "must be uniform where a code is diffused: no second position comes clean behind it",
        )?;
        let tells = "must be empty where a code is diffused: decoder and critics would not know of it";
        require(self.method.told.is_empty(), "method.told", tells)?;
        let reason = "of a model whose plan is a code must be [1]: what is done by it depends on the state of each step";
        require(self.trained.action_horizons == [1], "trained.action_horizons", reason)
    }

    fn check_kinds_told(&self, told: &[Told]) -> Result<(), Unfit> {
        let alike = |a: &Told, b: &Told| std::mem::discriminant(a) == std::mem::discriminant(b);
        let twice = told.iter().enumerate().any(|(i, a)| told[..i].iter().any(|b| alike(a, b)));
        require(!twice, "method.told", "names a kind twice")?;
        told.iter().try_for_each(|told| match told {
            Told::Return => Ok(()),
            Told::Goal { columns } => {
                let (field, state_dim) = ("method.told.columns", self.layout.state_dim);
                size(field, columns.len(), COLUMNS_MAX)?;
                let distinct = columns.iter().enumerate().all(|(i, column)| !columns[..i].contains(column));
                require(distinct, field, "names a column twice")?;
                // A recipe is checked before its data are known; then there is a state of one column.
                let within = state_dim == 1 || columns.iter().all(|column| *column < state_dim);
                require(within, field, format!("names a column that a state of {state_dim} columns does not have"))
            }
        })
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

/// Actions are part of the plan, or found by inverse dynamics.
fn check_head(diffused: Diffused, head: &Head, latent: &LatentSource) -> Result<(), Unfit> {
    match (diffused, head) {
        (Diffused::StateAction | Diffused::Action, Head::Direct) => Ok(()),
        (Diffused::StateAction | Diffused::Action, Head::Inverse { .. } | Head::Skill { .. }) => {
            require(false, "method.head", "must be direct where actions are diffused: they are there already")
        }
        (Diffused::State, Head::Direct | Head::Skill { .. }) => {
            require(false, "method.head", "must be inverse where states alone are diffused: nothing else makes actions of them")
        }
        (Diffused::Code { .. }, Head::Direct | Head::Inverse { .. }) => {
            require(false, "method.head", "must be skill where a code is diffused: nothing else makes actions of it")
        }
        (Diffused::Code { dim, steps }, Head::Skill { width, layers, action: _ }) => {
            size("method.plan.diffused.code.dim", dim, WIDTH_MAX)?;
            size("method.plan.diffused.code.steps", steps, HORIZON_MAX)?;
            size("method.head.width", *width, WIDTH_MAX)?;
            size("method.head.layers", *layers, LAYERS_MAX)?;
            require(
                *latent == LatentSource::None,
                "method.latent",
                "must be none where a code is diffused: the encoder of skills sees no latent",
            )
        }
        (Diffused::State, Head::Inverse { network, latent: sees }) => {
            match network {
                Inverse::Mlp { width } => size("method.head.network.width", *width, WIDTH_MAX)?,
                Inverse::Diffusion { width, steps } => {
                    size("method.head.network.width", *width, WIDTH_MAX)?;
                    size("method.head.network.steps", *steps, INVERSE_STEPS_MAX)?;
                }
            }
            require(!sees || latent.dim() > 0, "method.head.latent", "is true, but there is no latent (method.latent)")
        }
    }
}

fn check_guide(guide: Option<&Guide>, plan: &Diffusion, latent: &LatentSource) -> Result<(), Unfit> {
    match guide {
        None => Ok(()),
        Some(Guide::Value { widths }) => {
            let sees = plan.diffused.has_states();
            require(sees, "method.guide", "value needs windows with states: actions alone do not say where they are taken")?;
            check_value(widths, plan.horizon)
        }
        Some(Guide::Critic { width }) => {
            let acts = plan.diffused != Diffused::State;
            require(acts, "method.guide", "critic needs windows with actions, of which it judges the first, or of codes")?;
            size("method.guide.width", *width, WIDTH_MAX)
        }
        Some(guide @ (Guide::DecoderReturn | Guide::Dual { .. })) => {
            if let Guide::Dual { discrepancy } = guide {
                let reason = format!("is {discrepancy}, must be 0 or above, and finite");
                require(discrepancy.is_finite() && *discrepancy >= 0.0, "method.guide.discrepancy", reason)?;
            }
            // Beside a baseline the decoder tells what is surprising of a reward, and the rest is not the latent's.
            let tells = latent.gru().is_some_and(|gru| gru.baseline.is_none());
            let reason = "of this kind needs a latent whose decoder tells rewards (method.latent of kind gru without a baseline)";
            require(tells, "method.guide", reason)?;
            let acts = plan.diffused == Diffused::StateAction;
            require(acts, "method.guide", "of this kind needs windows of states and actions: a reward is told of both")
        }
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
        for (field, affine) in [("units.returns", &self.returns), ("units.context", &self.context)] {
            let sound = |affine: &Affine| {
                let scales = affine.std.iter().all(|std| std.is_normal() && *std > 0.0);
                scales && affine.std.len() == affine.dim() && affine.mean.iter().all(|mean| mean.is_finite())
            };
            require(affine.as_ref().is_none_or(sound), field, "a scale is zero, negative or not finite, or a mean is not")?;
        }
        let spread = self.latent_spread;
        require(spread.is_finite() && spread >= 0.0, "units.latent_spread", format!("is {spread}, must be 0 or above"))
    }
}

fn columns(field: &str, found: usize, expected: usize) -> Result<(), Unfit> {
    require(found == expected, field, format!("has {found} columns, expected {expected}"))
}

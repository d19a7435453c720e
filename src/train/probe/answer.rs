//! What `ada-trainer probe` finds and prints: a table for people, rows for `report/identification.json`.

use super::{AGES, Age, Score, Source, Subjects, beside_state, ceiling, latent_probe, prior_probe, probed};
use crate::{
    model::{checkpoint, latent::Evidence, method::Looks},
    train::dataset::{UnitsFrom, hdf5, room::Room},
};
use anyhow::{Context, Result, ensure};
use serde::Serialize;
use std::{collections::BTreeSet, path::Path};

/// Places of each side that the probe uses.
const ROWS: usize = 20_000;
const SHIFTS: [i32; 3] = [-1, 0, 1];
/// Block lengths of the ceiling beside a GRU that runs on.
const CEILINGS: [usize; 3] = [1, 4, 10];

/// What is asked.
pub struct Question<'a> {
    /// Directory of the checkpoint.
    pub checkpoint: &'a Path,
    /// Data set with `infos/context`.
    pub data: &'a Path,
    /// Steps that the prior is rolled out beyond the coming one.
    pub ahead: usize,
    /// Whether the data are rollouts of the agent itself.
    pub own_rollouts: bool,
    /// Instead of the name of the data set's file.
    pub environment: Option<&'a str>,
    /// Instead of the recipe's name.
    pub method: Option<&'a str>,
}

/// What rows are known by.
#[derive(Clone, Debug, PartialEq)]
pub struct Labels {
    environment: String,
    seed: u64,
    method: String,
    own_rollouts: bool,
}

/// What was found.
#[derive(Debug)]
pub struct Answer {
    /// In the order of the table.
    pub scores: Vec<Score>,
    /// What a person should know about the data.
    pub notes: Vec<String>,
    labels: Labels,
}

/// One row of `report/identification.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Where the data are from.
    pub environment: String,
    /// Of the training.
    pub seed: u64,
    /// The recipe.
    pub method: String,
    /// `held_out` episodes of the data set, or of the agent's `own_rollouts`.
    pub r#where: &'static str,
    /// `filter`: what a decision has; `successor`: also the action and what state it led to; `prior`: what a decision has, rolled out.
    pub evidence: &'static str,
    /// Steps beyond the coming one; 0 but for `prior`.
    pub ahead: usize,
    /// `block`, or `running` over the whole past.
    pub looks: &'static str,
    /// Tokens of a block.
    pub block_len: Option<usize>,
    /// Steps of the episode, from the first to before the second, or to its end; none: all at which the block lies whole in the episode.
    pub age: Option<(usize, Option<usize>)>,
    /// Standardised mean squared error of the latent, 1 - R2; none where the context does not vary.
    pub mse: Option<f64>,
    /// The same of the raw tokens.
    pub ceiling: Option<f64>,
    /// The same of the raw tokens but for their actions.
    pub ceiling_without_actions: Option<f64>,
    /// The same of the state at that moment alone; of a filter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub state: Option<f64>,
    /// The same of the latent beside that state.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mse_with_state: Option<f64>,
}

/// Probes a checkpoint against a data set: block lengths 1, 2, 4 and T_x, every evidence, shifts -1, 0, 1, the roll-out, and the ceilings.
///
/// # Errors
/// If either cannot be read, they do not fit, the model has no latent, or the data no context.
pub fn probe(question: &Question, room: &Room) -> Result<Answer> {
    let Question { checkpoint: dir, data, ahead, .. } = *question;
    let agent = checkpoint::load(dir)?;
    let config = agent.config();
    let latent = agent.networks().latent.as_ref().with_context(|| format!("{} has no latent to probe", dir.display()))?;
    let mut dataset = hdf5::read(data, room)?;
    let layout = dataset.layout();
    ensure!(
        layout == config.layout,
        "{}: {} states and {} actions, but the checkpoint has {} and {}",
        data.display(),
        layout.state_dim,
        layout.action_dim,
        config.layout.state_dim,
        config.layout.action_dim
    );
    dataset.leave_out_shorter(config.method.latent.block_len() + 2 + ahead, "the block length + 2 + what is asked ahead")?;
    let notes = std::mem::take(&mut dataset.notes);
    let (split, _) = dataset.split(UnitsFrom::Checkpoint(&config.units))?;
    let subjects = Subjects { train: &split.episodes.train, held_out: &split.episodes.held_out, rows_max: ROWS };
    let looks = config.method.latent.gru().map_or(Looks::Block(0), |gru| gru.looks);
    let mut scores = Vec::new();
    for looks in shorter(looks) {
        for evidence in probed(latent) {
            scores.extend(latent_probe(latent, &subjects, *evidence, looks, &SHIFTS)?);
        }
    }
    scores.extend(beside_state(latent, &subjects, looks)?);
    scores.extend(prior_probe(latent, &subjects, looks, ahead)?);
    let block_lens: Vec<usize> = shorter(looks).into_iter().map(Looks::block_len).collect();
    let block_lens: &[usize] = if looks == Looks::Running { &CEILINGS } else { &block_lens };
    scores.extend(ceiling(&subjects, looks, block_lens, ahead)?);
    Ok(Answer { scores, notes, labels: labels(question)? })
}

/// Block lengths up to the model's own; a GRU that runs on has none to choose.
fn shorter(looks: Looks) -> Vec<Looks> {
    match looks {
        Looks::Block(own) => {
            let lens: BTreeSet<usize> = [1, 2, 4, own].into_iter().filter(|len| *len <= own).collect();
            lens.into_iter().map(Looks::Block).collect()
        }
        Looks::Running => vec![Looks::Running],
    }
}

fn labels(question: &Question) -> Result<Labels> {
    let (manifest, _) = checkpoint::load_manifest(question.checkpoint)?;
    let stem = question.data.file_stem().unwrap_or_default().to_string_lossy();
    let recipe = toml::from_str::<toml::Table>(&manifest.provenance.recipe).unwrap_or_default();
    let name = recipe.get("name").and_then(toml::Value::as_str).unwrap_or("unknown");
    Ok(Labels {
        environment: question.environment.unwrap_or(&stem).into(),
        seed: manifest.provenance.seed,
        method: question.method.unwrap_or(name).into(),
        own_rollouts: question.own_rollouts,
    })
}

impl Answer {
    /// What `report/identification.json` holds: the latent where it is held against the context of its own step, beside the ceilings.
    pub fn rows(&self) -> Vec<Row> {
        let due = |score: &&Score| score.source == Source::Latent && score.shift == score.ahead as i32;
        let told = self.scores.iter().filter(due).filter_map(|score| Some((score, evidence(score)?)));
        let ages = || std::iter::once(None).chain((0..AGES.len()).map(Some));
        told.flat_map(|(score, evidence)| ages().map(move |age| self.row(score, evidence, age))).collect()
    }

    /// The rows as JSON, one a line.
    ///
    /// # Errors
    /// Never for rows made here.
    pub fn json(&self) -> serde_json::Result<String> {
        let lines: Vec<String> = self.rows().iter().map(serde_json::to_string).collect::<serde_json::Result<_>>()?;
        Ok(format!("[\n {}\n]", lines.join(",\n ")))
    }

    fn row(&self, score: &Score, evidence: &'static str, age: Option<usize>) -> Row {
        let Labels { environment, seed, method, own_rollouts } = self.labels.clone();
        let of = |score: &Score| {
            let error = age.map_or(score.errors.whole, |age| score.errors.ages[age]);
            error.is_finite().then(|| (error * 1e5).round() / 1e5)
        };
        let beside = |source| {
            let like = |other: &&Score| (other.source, other.evidence) == (source, score.evidence);
            let there = |other: &&Score| (other.looks, other.ahead) == (score.looks, score.ahead);
            self.scores.iter().filter(like).find(there).and_then(of)
        };
        Row {
            environment,
            seed,
            method,
            r#where: if own_rollouts { "own_rollouts" } else { "held_out" },
            evidence,
            ahead: score.ahead,
            looks: if score.looks == Looks::Running { "running" } else { "block" },
            block_len: Some(score.looks.block_len()).filter(|_| score.looks != Looks::Running),
            age: age.map(|age| (AGES[age].start, AGES[age].end)),
            mse: of(score),
            ceiling: beside(Source::Ceiling),
            ceiling_without_actions: beside(Source::CeilingWithoutActions),
            state: beside(Source::State),
            mse_with_state: beside(Source::LatentAndState),
        }
    }

    /// The table for people.
    pub fn table(&self) -> String {
        let mut text = HEAD.to_string();
        text += &format!("{:<19} {:<15} {:>5} {:>5} {:>5} {:>8}", "source", "evidence", "looks", "shift", "ahead", "error");
        text += &(AGES.iter().map(|age| format!(" {:>8}", Age::to_string(age))).collect::<String>() + "\n");
        text += &self.scores.iter().map(line).collect::<String>();
        let now = self.scores.iter().filter(|score| score.source == Source::Latent && score.ahead == 0);
        let best = now.min_by(|a, b| a.errors.whole.total_cmp(&b.errors.whole));
        text + &best.map_or_else(String::new, |best| format!("least error of the latent at shift {}\n", best.shift))
    }
}

/// The words of the table, a line each.
const HEAD: &str = "\
standardised mean squared error (1 - R2) of a linear probe for the hidden context, on held-out episodes: 0 is exactly, 1 not at all
  filter           what a decision has: the tokens before t, and s_t; the latent is the prior's for t
  successor_state  also a_t, r_t and the state that they led to; successor: that state's action and reward too
  prior            the filter's latent rolled out by the prior, so many steps ahead, held against the context there
  looks            how many tokens before t are seen; all: from the start of the episode
  shift            the estimate at t is held against the context at t + shift; least beside 0: the latent lags or hurries
  ceiling          what the raw tokens hold: ridge regression on each transition, then over those seen; \"no actions\": without any, since
                   an expert's tell the context that it sees (but a push that is not known also hides what the context did)
  state            what the state at t tells by itself; latent and state: both together, as a decision reads them
  error            where all of the block lies in the episode; beside it by age, in steps since the episode began, each with a probe of its own

";

fn line(score: &Score) -> String {
    let Score { source, looks, ahead, shift, errors, .. } = score;
    let source = match source {
        Source::Latent => "latent",
        Source::Ceiling => "ceiling",
        Source::CeilingWithoutActions => "ceiling, no actions",
        Source::State => "state",
        Source::LatentAndState => "latent and state",
    };
    let evidence = if *ahead > 0 { "prior" } else { seen(score.evidence) };
    let looks = match looks {
        Looks::Block(len) => len.to_string(),
        Looks::Running => "all".into(),
    };
    let ages: String = errors.ages.iter().map(|error| format!(" {}", number(*error))).collect();
    format!("{source:<19} {evidence:<15} {looks:>5} {shift:>5} {ahead:>5} {}{ages}\n", number(errors.whole))
}

fn number(error: f64) -> String {
    if error.is_finite() { format!("{error:>8.4}") } else { format!("{:>8}", "-") }
}

/// As rows know it; those of a whole successor token stay in the table, since its action tells of its own step.
fn evidence(score: &Score) -> Option<&'static str> {
    match score.evidence {
        Evidence::Filter if score.ahead > 0 => Some("prior"),
        Evidence::Filter => Some("filter"),
        Evidence::SuccessorState => Some("successor"),
        Evidence::Refinement | Evidence::Successor => None,
    }
}

fn seen(evidence: Evidence) -> &'static str {
    match evidence {
        Evidence::Filter => "filter",
        Evidence::Refinement => "refinement",
        Evidence::SuccessorState => "successor_state",
        Evidence::Successor => "successor",
    }
}

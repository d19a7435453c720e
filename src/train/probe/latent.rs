//! The linear probe of the latent's mean, as it is inferred and as the prior rolls it out.

use super::{Errors, Features, Place, Score, Source, Subjects, places, score};
use crate::{
    model::{
        latent::{Evidence, Gaussian, LatentModel},
        method::Looks,
        trajectory::Seen,
    },
    train::{
        dataset::{
            Episode,
            tokens::{TokenRows, histories},
        },
        ridge::Table,
    },
};
use anyhow::{Result, ensure};

/// Rows of one forward.
const CHUNK: usize = 512;
/// Penalty of the probe; its few latents do not need more than numerical safety.
const LAMBDA: f64 = 1e-6;

/// Shows the posterior at these places, `(rows, 1, dim)` for some of them at a time, in order.
fn posteriors(
    latent: &LatentModel,
    (episodes, places): (&[Episode], &[Place]),
    evidence: Evidence,
    looks: Looks,
    mut visit: impl FnMut(Gaussian) -> Result<()>,
) -> Result<()> {
    // A GRU that runs on reads each episode once.
    let together = |a: &Place, b: &Place| looks != Looks::Running || a.0 == b.0;
    for chunk in places.chunk_by(together).flat_map(|places| places.chunks(CHUNK)) {
        let pasts: Vec<_> = chunk.iter().map(|(episode, t)| (&episodes[*episode], *t as isize)).collect();
        let mut ahead = TokenRows::new(pasts[0].0);
        for (episode, t) in &pasts {
            evidence.ahead().iter().zip(*t..).try_for_each(|(seen, at)| ahead.push(episode, at, *seen))?;
        }
        let ahead = ahead.tokens(pasts.len(), evidence.ahead().len())?;
        visit(match looks {
            Looks::Block(_) => latent.infer_after(&latent.past(&histories(&pasts, looks, |_, _| Seen::ALL)?.0, None)?, &ahead)?,
            Looks::Running => {
                let (episode, reach) = (pasts[0].0, pasts[0].0.reach());
                let (at, len) = (chunk.iter().map(|(_, t)| reach + t).collect::<Vec<_>>(), reach + episode.len());
                let mut whole = TokenRows::new(episode);
                (0..len).try_for_each(|t| whole.push(episode, t as isize - reach as isize, Seen::ALL))?;
                latent.infer_within(&whole.tokens(1, len)?, &at, &ahead)?
            }
        })?;
    }
    Ok(())
}

/// Appends the means of a Gaussian of `(rows, 1, dim)`.
fn push(table: &mut Table, gaussian: &Gaussian) -> candle_core::Result<()> {
    table.width = gaussian.mean.dim(candle_core::D::Minus1)?;
    table.values.extend(gaussian.mean.flatten_all()?.to_vec1::<f32>()?.into_iter().map(f64::from));
    Ok(())
}

/// Latent means of c_t at these places: `(places, dim)`.
///
/// # Errors
/// If a tensor operation fails.
pub fn latent_means(latent: &LatentModel, episodes: &[Episode], places: &[Place], evidence: Evidence, looks: Looks) -> Result<Table> {
    let mut out = Table::new(0);
    posteriors(latent, (episodes, places), evidence, looks, |posterior| {
        Ok(push(&mut out, &if evidence == Evidence::Filter { latent.coming(posterior)? } else { posterior })?)
    })?;
    Ok(out)
}

/// Latent means of c_{t+1} .. c_{t+len}, as the sampler's window has them: by the prior from what a decision at t knows, or the belief of t held.
/// `len` tables of `(places, dim)`.
fn rolled_out(latent: &LatentModel, episodes: &[Episode], places: &[Place], looks: Looks, len: usize) -> Result<Vec<Table>> {
    let mut out = vec![Table::new(0); len + 1];
    posteriors(latent, (episodes, places), Evidence::Filter, looks, |posterior| {
        let mut tables = out.iter_mut();
        let each = |gaussian: &Gaussian| tables.next().map_or(Ok(()), |table| push(table, gaussian));
        Ok(latent.roll_out(posterior, len + 1, each)?)
    })?;
    Ok(out.split_off(1))
}

/// The linear probe of a latent model that looks back so far, with this evidence, over shifts.
///
/// # Errors
/// If the data have no context, or a tensor operation fails.
pub fn latent_probe(latent: &LatentModel, subjects: &Subjects, evidence: Evidence, looks: Looks, shifts: &[i32]) -> Result<Vec<Score>> {
    let context_dim = subjects.train.first().map_or(0, |episode| episode.context_dim);
    ensure!(context_dim > 0, "the data set has no `infos/context`, so there is no truth to probe for");
    let features = |episodes| -> Result<Features> {
        let places = places(episodes, subjects.rows_max);
        let table = latent_means(latent, episodes, &places, evidence, looks)?;
        Ok(Features { episodes, places, table })
    };
    let (fit, test) = (features(subjects.train)?, features(subjects.held_out)?);
    let line = |shift: &i32| {
        let errors = score(&fit, &test, *shift, looks.block_len(), LAMBDA)?;
        Ok(Score { source: Source::Latent, evidence, looks, ahead: 0, shift: *shift, errors })
    };
    shifts.iter().map(line).collect()
}

/// The linear probe of what a decision knows of 1 .. `len` steps later, each roll-out held against the context of its own step.
///
/// # Errors
/// As [`latent_probe`].
pub fn prior_probe(latent: &LatentModel, subjects: &Subjects, looks: Looks, len: usize) -> Result<Vec<Score>> {
    if len == 0 {
        return Ok(Vec::new());
    }
    let tables = |episodes| -> Result<_> {
        let places = places(episodes, subjects.rows_max);
        let tables = rolled_out(latent, episodes, &places, looks, len)?;
        Ok(tables.into_iter().map(move |table| Features { episodes, places: places.clone(), table }))
    };
    let line = |(ahead, (fit, test)): (usize, (Features, Features))| {
        let shift = ahead as i32;
        let errors: Errors = score(&fit, &test, shift, looks.block_len(), LAMBDA)?;
        Ok(Score { source: Source::Latent, evidence: Evidence::Filter, looks, ahead, shift, errors })
    };
    (1..).zip(tables(subjects.train)?.zip(tables(subjects.held_out)?)).map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{
        method::{Future, GruLatent},
        nn::params::Params,
        noise::Philox,
        trajectory::Layout,
    };

    const LAYOUT: Layout = Layout { state_dim: 2, action_dim: 1 };

    fn model(future: Future) -> LatentModel {
        let config = GruLatent { future, ..GruLatent::plain(3, 8, Looks::Block(4)) };
        LatentModel::new(&config, LAYOUT, &Params::fresh(4)).unwrap()
    }

    /// Of c_{t+n} a roll-out is the prior's n-th answer after that of the filter; a belief that is held stays.
    #[test]
    fn a_roll_out_begins_after_the_coming_step() {
        let mut rng = Philox::new(7);
        let mut noise = |len: usize| (0..len).map(|_| rng.normal()).collect::<Vec<f32>>();
        let episodes = [Episode::of(LAYOUT, [noise(40), noise(20), noise(20), noise(20)])];
        let (places, looks) = (places(&episodes, 100), Looks::Block(4));
        for future in [Future::Prior, Future::Held] {
            let model = model(future);
            let now = latent_means(&model, &episodes, &places, Evidence::Filter, looks).unwrap();
            let mut chain = vec![Table::new(0); 3];
            posteriors(&model, (&episodes, &places), Evidence::Filter, looks, |mut gaussian| {
                for table in &mut chain {
                    gaussian = model.coming(gaussian)?;
                    push(table, &gaussian)?;
                }
                Ok(())
            })
            .unwrap();
            assert_eq!(now, chain[0]);
            let rolled = rolled_out(&model, &episodes, &places, looks, 2).unwrap();
            assert_eq!(rolled, chain[1..]);
            assert_eq!(rolled[0] == now, future == Future::Held);
        }
    }
}

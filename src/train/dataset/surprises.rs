//! How surprising each step of a data set is, found out once: beside a baseline that learns no more it is the same in every batch, and asking
//! the baseline again for a whole history is most of the work of a small latent model.

use super::{
    Episode, Sides, Span,
    room::Room,
    rows::{FieldWriter, pieces, surprise_width},
    tokens::TokenRows,
};
use crate::{
    model::{
        latent::{Baseline, Tokens},
        trajectory::Seen,
    },
    train::parallel::side_by_side,
};
use anyhow::{Context, Result};
use candle_core::Tensor;
use std::{ops::Range, sync::Arc};

/// Rows of one forward: a fixed number, since another one may add up in another order.
const PIECE: usize = 2048;
/// Pieces that are computed side by side.
const TOGETHER: usize = 16;

/// The same episodes, whose steps tell their surprises. Rows are kept in a file where, beside those of the data, they take more than `room` has.
///
/// # Errors
/// If an episode cannot be read, the disk is full, or a tensor operation fails.
pub fn surprising(sides: &Sides, baseline: &Baseline, room: &Room) -> Result<Sides> {
    by_pieces(PIECE, sides, baseline, room)
}

fn by_pieces(piece: usize, sides: &Sides, baseline: &Baseline, room: &Room) -> Result<Sides> {
    let all = || sides.train.iter().chain(&sides.held_out);
    let rows = all().map(Episode::end).max().unwrap_or(0);
    let first = all().next().context("a data set without episodes: is a bug")?;
    // As if all rows were of one episode: who reads an episode's first step knows nothing of the one before it, so nobody looks at its arrival.
    let every = first.of_rows(Span { rows: 0..rows, play: false, ended: false, before: None });
    let width = surprise_width(first.layout);
    let in_file = first.in_file() || 4 * (rows * (first.columns() + width)) as u64 > room.memory_bytes;
    let mut writer = FieldWriter::new(width, rows, room, in_file)?;
    let pieces: Vec<Range<usize>> = pieces(0..rows, piece).collect();
    for together in pieces.chunks(TOGETHER) {
        let jobs = together.iter().map(|piece| || of_piece(&every, piece.clone(), baseline)).collect();
        side_by_side(jobs).into_iter().try_for_each(|values: Result<Vec<f32>>| Ok::<_, anyhow::Error>(writer.push(&values?)?))?;
    }
    let field = Arc::new(writer.finish()?);
    let told = |episodes: &[Episode]| episodes.iter().map(|episode| episode.telling(&field)).collect();
    Ok(Sides { train: told(&sides.train), held_out: told(&sides.held_out) })
}

/// Surprises of these steps, row after row.
fn of_piece(every: &Episode, piece: Range<usize>, baseline: &Baseline) -> Result<Vec<f32>> {
    let from = piece.start.saturating_sub(1);
    let mut rows = TokenRows::new(every);
    (from..piece.end).try_for_each(|t| rows.push(every, t as isize, Seen::ALL))?;
    let tokens: Tokens = rows.tokens(1, piece.end - from)?.following(None)?;
    let found = baseline.surprises(&tokens, true)?;
    let action = found.action.context("of actions too: is a bug")?;
    let all = Tensor::cat(&[found.state, action, found.reward], 2)?.narrow(1, piece.start - from, piece.len())?;
    Ok(all.flatten_all()?.to_vec1()?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::{
            Networks,
            method::{Baseline as Width, LatentSource},
            nn::params::Params,
            trajectory::Layout,
        },
        train::tests::recipe_with,
    };

    const LAYOUT: Layout = Layout { state_dim: 3, action_dim: 2 };
    const ROWS: usize = 23;

    fn networks() -> Networks {
        let mut recipe = recipe_with(&[]).unwrap();
        let LatentSource::Gru(gru) = &mut recipe.model.latent else { panic!("a latent") };
        gru.baseline = Some(Width { width: 4 });
        Networks::new(LAYOUT, &recipe.config(LAYOUT).method, &Params::fresh(3)).unwrap()
    }

    fn bits(sides: &Sides) -> Vec<u32> {
        let of = |episode: &Episode| {
            let steps: Vec<_> =
                (0..episode.len()).map(|t| episode.step(t as isize).unwrap().unwrap().surprise.unwrap().into_owned()).collect();
            steps.concat()
        };
        sides.train.iter().chain(&sides.held_out).flat_map(of).map(f32::to_bits).collect()
    }

    /// Whatever the pieces, and wherever rows are kept; the last row of one piece is what came before the first of the next.
    #[test]
    fn the_same_of_any_pieces() {
        let numbers = |count: usize, scale: f32| (0..count).map(|i| scale * (i as f32 * 0.7).sin()).collect::<Vec<f32>>();
        let columns = [numbers(ROWS * 3, 2.0), numbers(ROWS * 2, 1.0), numbers(ROWS, 1.0), Vec::new()];
        let first = Episode::among(LAYOUT, columns, Span { rows: 0..9, play: false, ended: false, before: None });
        let second = first.of_rows(Span { rows: 9..ROWS, play: true, ended: false, before: None });
        let sides = Sides { train: vec![second], held_out: vec![first] };
        let (networks, scratch) = (networks(), tempfile::tempdir().unwrap());
        let baseline = networks.latent.as_ref().and_then(|latent| latent.baseline.as_ref()).unwrap();
        let found = |piece, memory_bytes| {
            let told = by_pieces(piece, &sides, baseline, &Room { memory_bytes, scratch: scratch.path().into() }).unwrap();
            assert!(told.train[0].play && told.train[0].tells_surprises() && !sides.train[0].tells_surprises());
            bits(&told)
        };
        let whole = found(ROWS, u64::MAX);
        assert_eq!(whole.len(), ROWS * 6);
        for (piece, memory_bytes) in [(1, u64::MAX), (4, u64::MAX), (22, u64::MAX), (4, 0)] {
            assert_eq!(found(piece, memory_bytes), whole, "{piece}");
        }
    }
}

//! The latents of an act in progress, each known from the one before by the prior.

use super::types::are_finite;
use crate::model::latent::{GaussianRef, LOG_VAR};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Distributions of the latents from the act's first position on, `T + action_horizon - 1` of them; without any for a model without
/// latents.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Chain {
    mean: Vec<f32>,
    log_var: Vec<f32>,
    dim: usize,
    /// Which one belongs to position 0 of the window.
    first: usize,
}

impl Chain {
    pub(super) fn new(len: usize, dim: usize) -> Self {
        Self { mean: vec![0.0; len * dim], log_var: vec![0.0; len * dim], dim, first: 0 }
    }

    /// Whether it is one of so many latents of this width, none given out and all of them finite.
    pub(super) fn is_whole(&self, len: usize, dim: usize) -> bool {
        let sizes = self.mean.len() == len * dim && self.log_var.len() == len * dim;
        self.dim == dim && self.first == 0 && sizes && self.is_finite()
    }

    /// Whether all its numbers are.
    pub(super) fn is_finite(&self) -> bool {
        are_finite(&self.mean) && are_finite(&self.log_var)
    }

    pub(super) fn size_bytes(&self) -> usize {
        (self.mean.capacity() + self.log_var.capacity()) * size_of::<f32>()
    }

    /// How many belong to position 0 and those behind it.
    pub(super) fn len(&self) -> usize {
        self.mean.len().checked_div(self.dim).map_or(0, |len| len - self.first)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Width of a latent.
    pub(super) fn dim(&self) -> usize {
        self.dim
    }

    /// So many positions have been given out: the next one takes the place of position 0.
    pub(super) fn advance(&mut self, positions: usize) {
        if !self.is_empty() {
            self.first += positions;
        }
    }

    /// Mean of the latent of a step of the act, given out or not.
    pub(super) fn mean_of_step(&self, step: usize) -> &[f32] {
        &self.mean[step * self.dim..][..self.dim]
    }

    /// Means of the latents from the act's first step on.
    pub(super) fn write_means(&self, out: &mut [f32]) {
        out.copy_from_slice(&self.mean[..out.len()]);
    }

    /// Mean and log-variance at the act's first position.
    pub(super) fn of_first_step(&self) -> (Vec<f32>, Vec<f32>) {
        (self.mean[..self.dim].to_vec(), self.log_var[..self.dim].to_vec())
    }

    fn range(&self, position: usize) -> Range<usize> {
        let at = (self.first + position) * self.dim;
        at..at + self.dim
    }

    /// The latent of a position of the window; without any, of no columns.
    pub(super) fn get(&self, position: usize) -> GaussianRef<'_> {
        let range = self.range(position);
        GaussianRef { mean: &self.mean[range.clone()], log_var: &self.log_var[range] }
    }

    /// Means of the latents from position 0 on, of which nothing is uncertain.
    pub(super) fn set_certain(&mut self, means: &[f32]) {
        self.mean[..means.len()].copy_from_slice(means);
        self.log_var.fill(LOG_VAR.0);
    }

    /// Replaces it; positions beyond the last are not kept.
    pub(super) fn set(&mut self, position: usize, latent: GaussianRef) {
        if position < self.len() {
            let range = self.range(position);
            self.mean[range.clone()].copy_from_slice(latent.mean);
            self.log_var[range].copy_from_slice(latent.log_var);
        }
    }
}

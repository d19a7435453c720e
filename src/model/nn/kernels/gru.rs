//! The gated recurrent unit over a whole sequence, and back through time (PyTorch's form, gates in the order r, z, n):
//! `r = s(xr + hr)`, `z = s(xz + hz)`, `n = tanh(xn + r hn)`, `h' = (1 - z) n + z h`, where `x*` are the projected inputs (with
//! their bias) and `h*` the projected state (with its).

use super::{
    join, math, per_isa,
    pool::Pooled,
    product::{Every, InLine, Left, Packed, Row, Start, even_rows, product},
};

/// Sizes of a GRU at work.
#[derive(Clone, Copy, Debug)]
pub struct Gru {
    /// Sequences.
    pub batch: usize,
    /// Steps.
    pub steps: usize,
    /// Size of the state.
    pub hidden: usize,
}

/// A run that has been: what went in and what came out.
#[derive(Clone, Copy, Debug)]
pub struct GruRun<'a> {
    /// Projected inputs, `(batch, steps, 3 hidden)`.
    pub inputs: &'a [f32],
    /// Initial states, `(batch, hidden)`.
    pub initial: &'a [f32],
    /// All states, `(batch, steps, hidden)`.
    pub states: &'a [f32],
}

/// Recurrent parameters on the way back.
#[derive(Clone, Copy, Debug)]
pub struct GruWeights<'a> {
    /// The weight packed transposed, `(hidden, 3 hidden)`.
    pub forth: &'a Packed,
    /// The weight packed as it is, `(3 hidden, hidden)`.
    pub back: &'a Packed,
    /// By gate, `(3 hidden)`.
    pub bias: &'a [f32],
}

/// Where backward writes; it finds zeros.
pub struct GruGrads<'a> {
    /// To the projected inputs, `(batch, steps, 3 hidden)`.
    pub inputs: &'a mut [f32],
    /// To the initial state, `(batch, hidden)`.
    pub initial: &'a mut [f32],
    /// To the recurrent weights, `(3 hidden, hidden)`, if wanted.
    pub weight: Option<&'a mut [f32]>,
    /// To the recurrent bias, `(3 hidden)`, if wanted.
    pub bias: Option<&'a mut [f32]>,
}

per_isa! {
    /// The next state of one sequence from its projected input `x` and state `p` (3 hidden each) and its state `h`.
    fn step(x: &[f32], p: &[f32], h: &[f32], out: &mut [f32]) {
        let size = h.len();
        let ((xr, xz, xn), (pr, pz, pn)) = (thirds(x, size), thirds(p, size));
        for i in 0..out.len().min(size) {
            let (r, z) = (math::sigmoid(xr[i] + pr[i]), math::sigmoid(xz[i] + pz[i]));
            let n = math::tanh(r.mul_add(pn[i], xn[i]));
            out[i] = z.mul_add(h[i] - n, n);
        }
    }
}

/// The three gates' parts of a row.
#[inline(always)]
fn thirds(row: &[f32], size: usize) -> (&[f32], &[f32], &[f32]) {
    (&row[..size], &row[size..2 * size], &row[2 * size..3 * size])
}

/// One step of one sequence on the way back.
struct StepBack<'a> {
    /// Projected input.
    x: &'a [f32],
    /// Projected state; becomes its gradient.
    p: &'a mut [f32],
    /// State before the step.
    h: &'a [f32],
    /// Gradient to the projected input: result.
    dx: &'a mut [f32],
    /// Gradient to the state after the step; becomes the direct part of the gradient to the state before.
    dh: &'a mut [f32],
}

per_isa! {
    /// Back through the gates of one step.
    fn step_back(at: StepBack) {
        let size = at.h.len();
        let (xr, xz, xn) = thirds(at.x, size);
        let (pr, rest) = at.p.split_at_mut(size);
        let (pz, pn) = rest.split_at_mut(size);
        let (dr, rest) = at.dx.split_at_mut(size);
        let (dz, dn) = rest.split_at_mut(size);
        let (pn, dn, dh) = (&mut pn[..size], &mut dn[..size], &mut at.dh[..size]);
        for i in 0..size {
            let (r, z) = (math::sigmoid(xr[i] + pr[i]), math::sigmoid(xz[i] + pz[i]));
            let n = math::tanh(r.mul_add(pn[i], xn[i]));
            dn[i] = dh[i] * (1.0 - z) * (1.0 - n * n);
            dz[i] = dh[i] * (at.h[i] - n) * z * (1.0 - z);
            dr[i] = dn[i] * pn[i] * r * (1.0 - r);
            pr[i] = dr[i];
            pz[i] = dz[i];
            pn[i] = dn[i] * r;
            dh[i] *= z;
        }
    }
}

impl Gru {
    /// All states into `out`, `(batch, steps, hidden)`, from projected inputs `x` `(batch, steps, 3 hidden)` and initial states
    /// `(batch, hidden)`. `weight` is the recurrent weight packed transposed, `(hidden, 3 hidden)`.
    pub fn forward(&self, x: &[f32], initial: &[f32], (weight, bias): (&Packed, &[f32]), out: &mut [f32]) {
        let (size, row) = (self.hidden, 3 * self.hidden);
        let (mut state, mut projected) = (Pooled::take(self.batch * size), Pooled::take(self.batch * row));
        state.copy_from_slice(initial);
        for t in 0..self.steps {
            let rows = even_rows(self.batch, size, row, size);
            product(Left { values: &state, terms: InLine }, weight, Start::Bias(bias), &mut projected, rows);
            for b in 0..self.batch {
                let at = b * self.steps + t;
                let next = &mut out[at * size..][..size];
                step(&x[at * row..][..row], &projected[b * row..][..row], &state[b * size..][..size], next);
                state[b * size..][..size].copy_from_slice(next);
            }
        }
    }

    /// The state before each step, `(batch, steps, hidden)`.
    fn states_before(&self, run: GruRun) -> Pooled {
        let (mut before, len) = (Pooled::take(run.states.len()), self.steps * self.hidden);
        let items = run.initial.chunks_exact(self.hidden).zip(run.states.chunks_exact(len));
        for ((initial, states), before) in items.zip(before.chunks_exact_mut(len)) {
            let (first, rest) = before.split_at_mut(self.hidden);
            first.copy_from_slice(initial);
            rest.copy_from_slice(&states[..rest.len()]);
        }
        before
    }

    /// Gradients from `grad`, the gradient to the states of `run`.
    pub fn backward(&self, run: GruRun, recurrent: GruWeights, grad: &[f32], to: GruGrads) {
        let (size, row, count) = (self.hidden, 3 * self.hidden, self.batch * self.steps);
        let (before, mut projected) = (self.states_before(run), Pooled::take(count * row));
        let rows = even_rows(count, size, row, size);
        product(Left { values: &before, terms: InLine }, recurrent.forth, Start::Bias(recurrent.bias), &mut projected, rows);
        for t in (0..self.steps).rev() {
            for b in 0..self.batch {
                let at = b * self.steps + t;
                let dh = &mut to.initial[b * size..][..size];
                dh.iter_mut().zip(&grad[at * size..][..size]).for_each(|(dh, grad)| *dh += grad);
                let (p, dx) = (&mut projected[at * row..][..row], &mut to.inputs[at * row..][..row]);
                step_back(StepBack { x: &run.inputs[at * row..][..row], p, h: &before[at * size..][..size], dx, dh });
            }
            let rows = (0..self.batch).map(|b| Row { from: (b * self.steps + t) * row, to: b * size, terms: 0..row });
            product(Left { values: &projected, terms: InLine }, recurrent.back, Start::Out, to.initial, rows);
        }
        if let Some(weight) = to.weight {
            let before = Packed::scratch(&before, (Every(size), count), (size, 1));
            product(Left { values: &projected, terms: Every(row) }, &before, Start::Zero, weight, even_rows(row, 1, size, count));
        }
        if let Some(bias) = to.bias {
            join::add_rows(&projected, row, bias);
        }
    }
}

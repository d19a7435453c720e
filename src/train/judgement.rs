//! One sentence for whoever trained: what the latent found, and which key to turn first where that is little.

use super::{gate::Probed, learner::Scalars};

/// Errors of a probe above which the context counts as not found: half of its variance.
const POOR: f64 = 0.5;
/// Shares of what was surprising below which the latent explains next to nothing.
const LITTLE: f64 = 0.05;

/// From errors on held-out blocks, by their names in the log, and a probe, where the data tell a context. Beside a baseline errors are shares of
/// what was surprising; without one they say nothing of the latent alone.
pub fn sentence(held_out: &Scalars, beside_baseline: bool, probe: Option<&Probed>) -> String {
    let error = |name: &str| held_out.iter().find(|(found, _)| *found == name).map(|(_, error)| *error);
    let parts = ["state", "action", "reward"];
    let explained: Vec<(&str, f64)> = parts
        .into_iter()
        .filter_map(|part| Some((part, 1.0 - error(&format!("held_out_{part}_error"))?)))
        .filter(|_| beside_baseline)
        .collect();
    let mut text = "what is hidden:".to_string();
    if !explained.is_empty() {
        let shares: Vec<String> = explained.iter().map(|(part, share)| format!("{:.0} % in {part}s", 100.0 * share.max(0.0))).collect();
        text += &format!(" of what surprises a model without a context the latent explains {} (held-out episodes)", shares.join(", "));
    }
    if let Some(probe) = probe {
        let joint = if explained.is_empty() { "" } else { ";" };
        text += &format!("{joint} a linear probe of it finds infos/context to an error of {:.3} (0: exactly, 1: not at all)", probe.filter);
    }
    if explained.is_empty() && probe.is_none() {
        return "what is hidden: not known, since the data tell no infos/context; model.latent.baseline would tell what the latent explains".into();
    }
    let poor =
        probe.is_some_and(|probe| probe.filter > POOR) || (!explained.is_empty() && explained.iter().all(|(_, share)| *share < LITTLE));
    match (poor, beside_baseline) {
        (false, _) => text,
        (true, false) => text + ". That is little: try model.latent.baseline first",
        (true, true) => text + ". That is little: try a longer look (model.latent.looks; \"running\" is the longest) or more steps",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_says_what_was_found_and_what_to_try() {
        let errors = |error: f64| vec![("held_out_elbo", 3.0), ("held_out_state_error", error), ("held_out_action_error", 0.64)];
        let probe = |filter| Probed { filter, successor_state: None };
        let found = sentence(&errors(0.58), true, Some(&probe(0.134)));
        assert!(found.contains("42 % in states, 36 % in actions (held-out episodes); a linear probe"), "{found}");
        assert!(found.contains("an error of 0.134") && !found.contains("little"), "{found}");
        assert!(sentence(&errors(0.58), true, Some(&probe(0.9))).ends_with("or more steps"));
        assert!(sentence(&errors(1.2), false, Some(&probe(0.9))).ends_with("try model.latent.baseline first"));
        assert!(sentence(&vec![("held_out_state_error", 0.99)], true, None).contains("1 % in states"));
        assert!(sentence(&vec![("held_out_state_error", 0.99)], true, None).contains("That is little"));
        assert!(sentence(&errors(0.5), false, None).contains("not known"));
    }
}

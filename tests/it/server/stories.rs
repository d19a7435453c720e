//! The simulated world (`examples/simulate`) in short, and what it has to find out. `make simulate SEEDS=20000` is the long form.

use clap::Parser;
use simulate::{Flags, Verdicts};

// Both programs bring what they share.
#[allow(dead_code, clippy::duplicate_mod)]
#[path = "../../../examples/simulate/main.rs"]
mod simulate;

fn live(words: &str) -> Verdicts {
    simulate::run(&Flags::parse_from(format!("simulate --quiet {words}").split_whitespace())).unwrap()
}

#[test]
fn no_act_is_lost_and_none_given_twice_in_any_story() {
    let verdicts = live("--seeds 60");
    assert_eq!(verdicts.violations, 0, "{verdicts}");
    let sum = &verdicts.sum;
    assert!(sum.acts >= 60 * 50 && sum.replayed > 100 && sum.resets > 0 && sum.closed > 0 && sum.retried > 100, "{verdicts}");
    assert_eq!(sum.troubles.len(), 9, "each kind of trouble came: {verdicts}");
}

/// Each of these worlds is wrong in a way of its own, and it is found out.
#[test]
fn what_is_wrong_in_a_story_is_found_out() {
    let wrong = |control: &str| live(&format!("--seeds 8 --control {control}"));
    let forgetful = wrong("forgetful");
    assert!(forgetful.sum.lost > 0, "{forgetful}");
    let rollback = wrong("rollback");
    assert!(rollback.sum.lost > 0, "{rollback}");
    let lies = wrong("lies");
    assert!(lies.sum.lost + lies.sum.corrupt > 0, "{lies}");
    let noise = wrong("noise");
    assert!(noise.sum.different > 0, "{noise}");
}

/// A story that is lived again is the same one: what happens to whom, and what they see of it. (Ids of sessions are random, and nothing hangs on their order
/// in these two.)
#[test]
fn a_seed_tells_the_whole_story() {
    let again = || live("--first 7 --seeds 2 --jobs 1");
    assert_eq!(again(), again());
}

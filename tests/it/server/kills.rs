//! The crasher (`examples/chaos`) in short, and what it has to find out. `make chaos KILLS=1000` is the long form.

use chaos::{Control, Flags, Verdicts};
use clap::Parser;

// Both programs bring what they share.
#[allow(dead_code, clippy::duplicate_mod)]
#[path = "../../../examples/chaos/main.rs"]
mod chaos;

async fn kill(words: &str) -> Verdicts {
    let fixed = format!("chaos --quiet --sessions 8 --server {} {words}", env!("CARGO_BIN_EXE_ada-server"));
    chaos::run(&Flags::parse_from(fixed.split_whitespace())).await.unwrap()
}

/// A thousand are killed by hand; so many here.
#[tokio::test(flavor = "multi_thread")]
async fn no_act_is_lost_and_none_given_twice() {
    for durability in ["process", "power"] {
        let verdicts = kill(&format!("--kills 12 --durability {durability}")).await;
        assert_eq!(verdicts.sum.found(), 0, "{durability}: {verdicts}");
        let sum = &verdicts.sum;
        assert!(sum.troubles.len() > 5 && sum.troubles.values().sum::<u64>() > 9, "each in its way: {verdicts}");
        assert!(sum.acts > 100 && sum.replayed > 10 && sum.resets > 0 && sum.closed > 0, "{durability}: {verdicts}");
    }
}

/// Each of these servers is wrong in a way of its own, and the crasher says so.
#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_is_found_out() {
    let forgetful = kill("--kills 3 --control forgetful").await;
    assert!(forgetful.sum.lost > 0, "{:?}: {forgetful}", Control::Forgetful);
    let rollback = kill("--kills 9 --control rollback").await;
    assert!(rollback.sum.lost > 0, "{:?}: {rollback}", Control::Rollback);
    let noise = kill("--kills 1 --control noise").await;
    assert!(noise.sum.different > 0, "{:?}: {noise}", Control::Noise);
    let damage = kill("--kills 6 --control damage").await;
    assert!(damage.sum.corrupt > 0, "{:?}: {damage}", Control::Damage);
}

//! Harm on demand, so that what the server does about it can be shown: at a named point of an act's way the process is killed, the thread panics or
//! hangs, the network's output is not finite, or memory is lost. `--fault POINT=HARM[:MS|:KB][@N|@state=VALUE]` arms one. Unarmed, a point costs one branch.

use std::{str::FromStr, sync::Arc, sync::atomic::AtomicU64, sync::atomic::Ordering, thread, time::Duration};

/// A point of an act's way; an act comes to each of them once, but for `Evaluating`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Point {
    /// The act is accepted, and about to enter the queue.
    Admitted,
    /// A network evaluation that the act takes part in: once for each of them.
    Evaluating,
    /// The act is computed, and nothing of it is committed.
    Computed,
    /// The commit is in the store, where there is one, and neither in memory nor told.
    Stored,
    /// The answer was handed to the connection a moment ago.
    Told,
    /// The drain begins: of the process, not of an act.
    Draining,
}

/// What is done there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Harm {
    /// The process ends at once, and nothing of it is tidied up.
    Kill,
    /// The thread panics.
    Panic,
    /// The thread stands still for so long; None: for ever.
    Hang(Option<Duration>),
    /// So much memory is taken and never given back.
    Leak {
        /// Thousands of bytes.
        kb: usize,
    },
    /// The act's numbers turn into NaN; at `Evaluating` alone.
    Nonfinite,
}

/// To whom.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Whom {
    /// Every act.
    All,
    /// The n-th arrival at the point, counted from 1 and over the life of the process.
    Nth(u64),
    /// Every act whose observation begins with this value.
    State(f32),
}

/// One fault, as `POINT=HARM[:MS|:KB][@N|@state=VALUE]` says it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fault {
    point: Point,
    harm: Harm,
    whom: Whom,
}

/// Why a text is none.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what}; expected POINT=HARM[:MS|:KB][@N|@state=VALUE], e.g. evaluating=panic@state=7, computed=kill@100 or evaluating=hang:500@1")]
pub struct NoFault {
    what: String,
}

impl FromStr for Fault {
    type Err = NoFault;

    fn from_str(text: &str) -> Result<Self, NoFault> {
        let wrong = |what: String| NoFault { what };
        let (point, rest) = text.split_once('=').ok_or_else(|| wrong("no harm is named".into()))?;
        let (harm, whom) = rest.split_once('@').map_or((rest, None), |(harm, whom)| (harm, Some(whom)));
        let (harm, size) = harm.split_once(':').map_or((harm, None), |(harm, size)| (harm, Some(size)));
        let (point, harm) = (point_of(point).map_err(wrong)?, harm_of(harm, size).map_err(wrong)?);
        let whom = whom.map_or(Ok(Whom::All), whom_of).map_err(wrong)?;
        if harm == Harm::Nonfinite && point != Point::Evaluating {
            return Err(wrong("nonfinite is for evaluating alone".into()));
        }
        if point == Point::Draining && matches!(whom, Whom::State(_)) {
            return Err(wrong("draining is of no act, so it has no state".into()));
        }
        Ok(Self { point, harm, whom })
    }
}

fn point_of(word: &str) -> Result<Point, String> {
    match word {
        "admitted" => Ok(Point::Admitted),
        "evaluating" => Ok(Point::Evaluating),
        "computed" => Ok(Point::Computed),
        "stored" => Ok(Point::Stored),
        "told" => Ok(Point::Told),
        "draining" => Ok(Point::Draining),
        _ => Err(format!("{word:?} is no point; there are admitted, evaluating, computed, stored, told, draining")),
    }
}

fn harm_of(word: &str, size: Option<&str>) -> Result<Harm, String> {
    let number = |of: &str| size.map(|size| size.parse::<u32>().map_err(|_| format!("{size:?} is no number of {of}"))).transpose();
    match (word, size) {
        ("hang", _) => Ok(Harm::Hang(number("milliseconds")?.map(|ms| Duration::from_millis(ms.into())))),
        ("leak", _) => number("kilobytes")?.map(|kb| Harm::Leak { kb: kb as usize }).ok_or_else(|| "a leak takes its kilobytes".into()),
        (_, Some(_)) => Err("only a hang takes a time, and a leak its kilobytes".into()),
        ("kill", None) => Ok(Harm::Kill),
        ("panic", None) => Ok(Harm::Panic),
        ("nonfinite", None) => Ok(Harm::Nonfinite),
        _ => Err(format!("{word:?} is no harm; there are kill, panic, hang, leak, nonfinite")),
    }
}

fn whom_of(text: &str) -> Result<Whom, String> {
    let nth = || text.parse().ok().filter(|n| *n > 0).map(Whom::Nth);
    match text.strip_prefix("state=") {
        Some(value) => value.parse().map(Whom::State).map_err(|_| format!("{value:?} is no number")),
        None => nth().ok_or_else(|| format!("{text:?} is neither a number from 1 nor state=VALUE")),
    }
}

/// All faults that are armed; clones share their counts. The default has none.
#[derive(Clone, Debug, Default)]
pub struct Faults(Option<Arc<[Armed]>>);

#[derive(Debug)]
struct Armed {
    fault: Fault,
    reached: AtomicU64,
}

impl Faults {
    /// Arms these.
    pub fn new(faults: &[Fault]) -> Self {
        let arm = |fault: &Fault| Armed { fault: *fault, reached: AtomicU64::new(0) };
        Self((!faults.is_empty()).then(|| faults.iter().map(arm).collect()))
    }

    /// Whether there is any.
    pub fn are_armed(&self) -> bool {
        self.0.is_some()
    }

    /// An act whose observation begins with this value has come to a point: what is to be done to it.
    #[inline]
    pub fn at(&self, point: Point, first: Option<f32>) -> Option<Harm> {
        self.0.as_deref().and_then(|armed| armed.iter().find(|armed| armed.strikes(point, first)).map(|armed| armed.fault.harm))
    }

    /// The same, done.
    #[inline]
    pub fn reach(&self, point: Point, first: Option<f32>) {
        if let Some(harm) = self.at(point, first) {
            harm.strike(point);
        }
    }
}

/// Settings with the same faults are the same, however often those have been reached.
impl PartialEq for Faults {
    fn eq(&self, other: &Self) -> bool {
        let faults = |faults: &Self| faults.0.iter().flat_map(|armed| armed.iter().map(|armed| armed.fault)).collect::<Vec<_>>();
        faults(self) == faults(other)
    }
}

impl Armed {
    fn strikes(&self, point: Point, first: Option<f32>) -> bool {
        self.fault.point == point
            && match self.fault.whom {
                Whom::All => true,
                Whom::Nth(n) => self.reached.fetch_add(1, Ordering::Relaxed) + 1 == n,
                Whom::State(value) => first == Some(value),
            }
    }
}

impl Harm {
    /// Does it to the thread, or the process. An act's numbers are its owner's to spoil.
    pub fn strike(self, point: Point) {
        match self {
            Self::Kill => std::process::abort(),
            Self::Panic => panic!("a fault that was asked for, at {point:?}"),
            Self::Hang(Some(time)) => thread::sleep(time),
            Self::Hang(None) => loop {
                thread::park();
            },
            // Written to, or the system would only promise it.
            Self::Leak { kb } => std::mem::forget(vec![1_u8; kb * 1000]),
            Self::Nonfinite => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(text: &str) -> Fault {
        text.parse().unwrap()
    }

    #[test]
    fn faults_are_read() {
        let at = |point, harm, whom| Fault { point, harm, whom };
        assert_eq!(fault("admitted=kill"), at(Point::Admitted, Harm::Kill, Whom::All));
        assert_eq!(fault("evaluating=hang"), at(Point::Evaluating, Harm::Hang(None), Whom::All));
        assert_eq!(fault("told=hang:250@3"), at(Point::Told, Harm::Hang(Some(Duration::from_millis(250))), Whom::Nth(3)));
        assert_eq!(fault("evaluating=nonfinite@state=-1.5"), at(Point::Evaluating, Harm::Nonfinite, Whom::State(-1.5)));
        assert_eq!(fault("told=leak:64"), at(Point::Told, Harm::Leak { kb: 64 }, Whom::All));
        assert_eq!(fault("draining=panic@1"), at(Point::Draining, Harm::Panic, Whom::Nth(1)));
        for (text, says) in [
            ("computed", "no harm"),
            ("nowhere=kill", "there are admitted"),
            ("stored=tickle", "there are kill"),
            ("stored=kill:5", "only a hang"),
            ("stored=leak", "its kilobytes"),
            ("stored=leak:much", "no number of kilobytes"),
            ("stored=hang:soon", "milliseconds"),
            ("stored=nonfinite", "evaluating alone"),
            ("stored=kill@0", "neither a number from 1"),
            ("stored=kill@state=x", "no number"),
            ("draining=kill@state=1", "of no act"),
        ] {
            let error = text.parse::<Fault>().unwrap_err().to_string();
            assert!(error.contains(says) && error.contains("expected POINT=HARM"), "{text}: {error}");
        }
    }

    #[test]
    fn each_strikes_whom_it_is_for() {
        let faults = Faults::new(&["computed=panic@2", "stored=hang:1@state=7", "told=kill"].map(fault));
        let others = faults.clone();
        assert_eq!(faults.at(Point::Computed, Some(7.0)), None);
        assert_eq!(others.at(Point::Computed, None), Some(Harm::Panic), "clones count together");
        assert_eq!(faults.at(Point::Computed, None), None, "once");
        let hang = Some(Harm::Hang(Some(Duration::from_millis(1))));
        assert_eq!([7.0, 7.5, 7.0].map(|first| faults.at(Point::Stored, Some(first))), [hang, None, hang]);
        assert_eq!((faults.at(Point::Told, None), faults.at(Point::Admitted, Some(7.0))), (Some(Harm::Kill), None));
        assert!(faults.are_armed() && !Faults::default().are_armed() && !Faults::new(&[]).are_armed());
        assert_eq!(Faults::default().at(Point::Told, Some(7.0)), None);
    }
}

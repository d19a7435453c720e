use super::*;
use crate::serve::store::{Store, VERSION_LEN};
use uuid::Uuid;

const OPTIONS: Options = Options { durability: Durability::Process, cache_bytes: 1 << 20, len_max: 1_000, bytes_max: 1 << 30 };

fn handle(i: u128) -> Handle {
    Handle::of(Uuid::from_u128(i))
}

fn at(step: u64) -> Version {
    Version { model: 7, episode: 0, step }
}

fn keep(i: u128, from: Option<u64>, step: u64, len: usize) -> Write {
    let bytes = [&at(step).bytes()[..], &vec![step as u8; len]].concat();
    Write { handle: handle(i), change: Change::Keep { from: from.map(at), bytes, name: None } }
}

fn step_of(home: &Embedded, i: u128) -> Option<u64> {
    match home.read(handle(i)).unwrap() {
        Place::Kept(bytes) => {
            let step = Version::of(&bytes).unwrap().step;
            assert!(bytes[VERSION_LEN..].iter().all(|byte| *byte == step as u8), "of one piece");
            Some(step)
        }
        Place::Ended(_) | Place::Empty => None,
    }
}

#[test]
fn what_is_kept_is_there_and_goes_on_from_what_was_there() {
    let dir = tempfile::tempdir().unwrap();
    let home = Embedded::open(dir.path(), OPTIONS).unwrap();
    let outcomes =
        home.write(&[keep(1, None, 0, 9), keep(2, None, 0, 5_000), keep(1, Some(0), 1, 9), keep(1, Some(0), 1, 9), keep(3, Some(4), 5, 1)]);
    assert_eq!(outcomes, Ok(vec![Ok(()), Ok(()), Ok(()), Err(Refused::Conflict), Err(Refused::Conflict)]));
    assert_eq!((step_of(&home, 1), step_of(&home, 2), step_of(&home, 3)), (Some(1), Some(0), None));
    assert_eq!(home.size().unwrap().sessions, 2);
    // Another model, or another episode, is another version.
    for other in [Version { model: 8, ..at(1) }, Version { episode: 1, ..at(1) }] {
        let change = Change::Keep { from: Some(other), bytes: at(2).bytes().to_vec(), name: None };
        assert_eq!(home.write(&[Write { handle: handle(1), change }]), Ok(vec![Err(Refused::Conflict)]));
    }
    let handles: Vec<_> = home.page(None, 10).unwrap().into_iter().map(|(handle, _)| handle).collect();
    let mut sorted = vec![handle(1), handle(2)];
    sorted.sort();
    assert_eq!(handles, sorted);
    assert_eq!(home.page(Some(sorted[0]), 10).unwrap()[0].0, sorted[1]);
}

#[test]
fn endings_and_names_are_remembered() {
    let dir = tempfile::tempdir().unwrap();
    let (name, other) = ([1; 16], [2; 16]);
    let named = |i, name| {
        let Change::Keep { from, bytes, .. } = keep(i, None, 0, 1).change else { unreachable!() };
        Write { handle: handle(i), change: Change::Keep { from, bytes, name: Some(name) } }
    };
    let free = |i, ending, name| Write { handle: handle(i), change: Change::Free { from: None, ending, name } };
    {
        let home = Embedded::open(dir.path(), OPTIONS).unwrap();
        home.write(&[
            named(1, name),
            named(2, other),
            free(1, Some((Ending::Expired, 50)), Some(name)),
            free(3, Some((Ending::Evicted, 60)), Some(other)),
        ])
        .unwrap();
    }
    let home = Embedded::open(dir.path(), OPTIONS).unwrap();
    assert_eq!((home.read(handle(1)), home.read(handle(3))), (Ok(Place::Ended(Ending::Expired)), Ok(Place::Ended(Ending::Evicted))));
    assert_eq!((home.named(name), home.named(other)), (Ok(None), Ok(Some(handle(2)))), "a name is taken from its own session alone");
    assert_eq!(home.forget_endings(60), Ok(1));
    assert_eq!((home.read(handle(1)), home.read(handle(3))), (Ok(Place::Empty), Ok(Place::Ended(Ending::Evicted))));
    home.write(&[free(2, None, Some(other))]).unwrap();
    assert_eq!((home.read(handle(2)), home.named(other)), (Ok(Place::Empty), Ok(None)));
}

/// One server has the file; another one says so.
#[test]
fn a_file_has_one_server() {
    let dir = tempfile::tempdir().unwrap();
    let _first = Embedded::open(dir.path(), OPTIONS).unwrap();
    let second = Embedded::open(dir.path(), OPTIONS);
    assert!(matches!(&second, Err(StoreError::Unavailable(reason)) if reason.contains("already open")), "{:?}", second.err());
}

/// What the medium was told, in order.
#[derive(Clone, Debug)]
enum Op {
    Write(u64, Vec<u8>),
    SetLen(u64),
    Sync,
}

/// A medium in memory that notes what it is told, and has no room while it is full.
#[derive(Clone, Debug, Default)]
struct Noted {
    image: Arc<Mutex<Vec<u8>>>,
    ops: Arc<Mutex<Vec<Op>>>,
    is_full: Arc<AtomicBool>,
}

impl StorageBackend for Noted {
    fn len(&self) -> io::Result<u64> {
        Ok(self.image.lock().len() as u64)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        out.copy_from_slice(&self.image.lock()[offset as usize..][..out.len()]);
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.note(Op::SetLen(len))
    }

    fn sync_data(&self) -> io::Result<()> {
        self.note(Op::Sync)
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.note(Op::Write(offset, data.to_vec()))
    }
}

impl Noted {
    fn note(&self, op: Op) -> io::Result<()> {
        if self.is_full.load(Ordering::Relaxed) {
            return Err(io::ErrorKind::StorageFull.into());
        }
        apply(&mut self.image.lock(), &op);
        self.ops.lock().push(op);
        Ok(())
    }

    fn of(image: Vec<u8>) -> Self {
        Self { image: Arc::new(Mutex::new(image)), ..Self::default() }
    }

    fn home(&self) -> Result<Embedded, StoreError> {
        let medium = self.clone();
        Embedded::over(move || medium.clone(), OPTIONS)
    }
}

fn apply(image: &mut Vec<u8>, op: &Op) {
    match op {
        Op::Write(offset, data) => image[*offset as usize..][..data.len()].copy_from_slice(data),
        Op::SetLen(len) => image.resize(*len as usize, 0),
        Op::Sync => {}
    }
}

/// What may be left of the medium when the power goes after so many operations: all of them, the last one torn; nothing since the last sync; or of what came
/// since, every other one.
fn left(ops: &[Op]) -> Vec<Vec<u8>> {
    let synced = ops.iter().rposition(|op| matches!(op, Op::Sync)).map_or(0, |index| index + 1);
    let image = |ops: &mut dyn Iterator<Item = &Op>| {
        let mut image = Vec::new();
        ops.for_each(|op| apply(&mut image, op));
        image
    };
    let kept = || ops[..synced].iter();
    let later = || ops[synced..].iter().enumerate();
    let always = |op: &Op| matches!(op, Op::SetLen(_));
    let mut images = vec![image(&mut ops.iter()), image(&mut kept())];
    for part in 0..2 {
        images.push(image(&mut kept().chain(later().filter(|(i, op)| i % 2 == part || always(op)).map(|(_, op)| op))));
    }
    if let Some((Op::Write(offset, data), before)) = ops.split_last() {
        let torn = Op::Write(*offset, data[..data.len() / 2].to_vec());
        images.push(image(&mut before.iter().chain([&torn])));
    }
    images
}

/// Whenever the power goes, what was acknowledged is there, at most one commit more, and each record in one piece.
#[test]
fn what_is_acknowledged_outlives_the_power() {
    let medium = Noted::default();
    let home = medium.home().unwrap();
    let mut acked = vec![(medium.ops.lock().len(), None)];
    for step in 0..24_u64 {
        // Records that grow and shrink move the tree.
        let len = [40, 9_000, 700, 3_000][step as usize % 4];
        home.write(&[keep(1, step.checked_sub(1), step, len), keep(100 + u128::from(step), None, step, 5_000)]).unwrap();
        acked.push((medium.ops.lock().len(), Some(step)));
    }
    let ops = medium.ops.lock().clone();
    let (first, mut looked) = (acked[0].0, 0);
    for cut in first..=ops.len() {
        let (_, least) = *acked.iter().rev().find(|(at, _)| *at <= cut).unwrap();
        let most = acked.iter().find(|(at, _)| *at > cut).map_or(least, |(_, step)| *step);
        for image in left(&ops[..cut]) {
            let found = step_of(&Noted::of(image).home().unwrap(), 1);
            assert!(found == least || found == most, "after {cut} operations: {found:?}, and {least:?} was acknowledged");
            looked += 1;
        }
    }
    assert!(looked > 400, "{looked}");
}

/// A session more is refused where there is no room, those that are there go on, and one that leaves makes room.
#[test]
fn sessions_are_bounded_in_number_and_in_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let few = Options { len_max: 2, ..OPTIONS };
    let home = Embedded::open(dir.path(), few).unwrap();
    let outcomes = home.write(&[keep(1, None, 0, 50), keep(2, None, 0, 50), keep(3, None, 0, 50), keep(1, Some(0), 1, 90)]);
    assert_eq!(outcomes, Ok(vec![Ok(()), Ok(()), Err(Refused::Full), Ok(())]));
    let free = |i, from: Option<u64>| Write { handle: handle(i), change: Change::Free { from: from.map(at), ending: None, name: None } };
    // What has gone on meanwhile is not freed.
    assert_eq!(home.write(&[free(1, Some(0)), keep(3, None, 0, 50)]), Ok(vec![Err(Refused::Conflict), Err(Refused::Full)]));
    assert_eq!(home.write(&[free(1, Some(1)), keep(3, None, 0, 50)]), Ok(vec![Ok(()), Ok(())]));
    assert_eq!((step_of(&home, 1), step_of(&home, 3)), (None, Some(0)));
    let bytes = |records: u64| records * (50 + VERSION_LEN as u64);
    assert_eq!((home.size().unwrap().sessions, home.size().unwrap().bytes), (2, bytes(2)));
    drop(home);
    // Bytes are counted over restarts.
    let home = Embedded::open(dir.path(), Options { bytes_max: 8 << 20, ..OPTIONS }).unwrap();
    assert!(home.size().unwrap().bytes <= COUNT_SLACK, "so far off it may be");
    let mut refused = None;
    for i in 10..4_000 {
        if let Err(Refused::Full) = home.write(&[keep(i, None, 0, 9_000)]).unwrap()[0] {
            refused = Some(i);
            break;
        }
    }
    let held = home.size().unwrap();
    drop(home);
    let home = Embedded::open(dir.path(), Options { bytes_max: 8 << 20, ..OPTIONS }).unwrap();
    assert!(home.size().unwrap().bytes.abs_diff(held.bytes) <= COUNT_SLACK, "over a restart");
    assert!(refused.is_some() && held.bytes * SPREAD <= 8 << 20 && (held.bytes + 10_000 + COUNT_SLACK) * SPREAD > 8 << 20, "{held:?}");
    for step in 0..200 {
        assert_eq!(home.write(&[keep(10, Some(step), step + 1, 9_000)]), Ok(vec![Ok(())]), "those that are there go on");
    }
    assert!(home.size().unwrap().medium_bytes <= 8 << 20);
}

/// Without room nothing is acknowledged; once there is room it goes on from what was acknowledged, without a restart.
#[test]
fn room_that_comes_back_is_found() {
    let medium = Noted::default();
    let home = Arc::new(medium.home().unwrap());
    let store = Store::start(home.clone(), 10).unwrap();
    let write = |write: Write| {
        let (told, outcome) = std::sync::mpsc::channel();
        store.submit(write, move |outcome| told.send(outcome).unwrap());
        outcome.recv().unwrap()
    };
    assert_eq!((write(keep(1, None, 0, 9_000)), store.is_sound()), (Ok(Ok(())), Ok(())));
    medium.is_full.store(true, Ordering::Relaxed);
    for _ in 0..3 {
        assert!(matches!(write(keep(1, Some(0), 1, 9_000)), Err(StoreError::Full(_))));
    }
    assert!(matches!(store.is_sound(), Err(StoreError::Full(_))));
    store.upkeep();
    assert!(store.is_sound().is_err(), "it is full still");
    medium.is_full.store(false, Ordering::Relaxed);
    std::thread::sleep(REST);
    store.upkeep();
    assert_eq!(store.is_sound(), Ok(()));
    assert_eq!((write(keep(1, Some(0), 1, 9_000)), step_of(&home, 1)), (Ok(Ok(())), Some(1)));
}

/// What waits is written when the store closes, and what comes later is refused.
#[test]
fn what_waits_is_written() {
    let medium = Noted::default();
    let home = Arc::new(medium.home().unwrap());
    let store = Store::start(home.clone(), 1_000).unwrap();
    for i in 0..300 {
        store.submit(keep(i, None, 0, 90), |outcome| assert_eq!(outcome, Ok(Ok(()))));
    }
    store.close();
    assert_eq!(home.size().unwrap().sessions, 300);
    let (told, outcome) = std::sync::mpsc::channel();
    store.submit(keep(900, None, 0, 90), move |outcome| told.send(outcome).unwrap());
    assert!(matches!(outcome.recv().unwrap(), Err(StoreError::Unavailable(_))));
}

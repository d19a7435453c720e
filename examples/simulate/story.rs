//! One story: what happens, and when, is drawn from its seed.

use super::{
    disk::{Disk, Ill},
    flags::{Control, Flags},
    life::{Life, Lot},
    net::{Port, SERVER, dial},
    tally::{Sum, Tally},
};
use ada_diffuser::{
    model::noise::Philox,
    serve::{
        config::{Config, ModelsConfig},
        registry::Registry,
        serve,
        service::{Hands, Service},
        store::{Durability, Embedded, Home, Options},
    },
};
use parking_lot::Mutex;
use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};
use tokio::{task::spawn_local, time::sleep};
use tokio_util::sync::CancellationToken;
use turmoil::{Builder, Sim};

/// Of the simulated clock.
const TICK: Duration = Duration::from_millis(1);
/// A call that is not answered by then is made again: a connection that lost a message never goes on.
const CALL_MAX: Duration = Duration::from_millis(500);
/// Troubles come in such distances.
const PEACE_MS: usize = 400;
/// And last for so long.
const TROUBLE_MS: usize = 250;
/// Operations of the disk until it dies: those of a commit or two.
const OPS_MAX: usize = 40;
/// A story that has no end by then has none.
const END: Duration = Duration::from_secs(600);
/// Nor is more waited for than for so long, for its acts.
const ACTS_MAX: Duration = Duration::from_secs(120);

/// What all stories share.
pub struct Stage {
    flags: Flags,
    registry: Registry,
}

impl Stage {
    /// Loads the model.
    ///
    /// # Errors
    /// If it cannot be loaded.
    pub fn new(flags: &Flags) -> anyhow::Result<Self> {
        let config = ModelsConfig { dir: flags.models.clone(), default: flags.model.clone(), ..ModelsConfig::default() };
        Ok(Self { flags: flags.clone(), registry: Registry::load(&config)? })
    }
}

/// What may happen.
#[derive(Clone, Copy, Debug)]
enum Trouble {
    Killed,
    PowerGone,
    DiesInCommit,
    Drains,
    Partitioned(u32),
    Held(u32),
    DiskFull,
    DiskBroken,
    DiskDoubtful,
}

/// What is to be done at a time.
#[derive(Clone, Copy, Debug)]
enum Deed {
    Trouble,
    Start,
    Repair(u32),
    Release(u32),
    Heal,
}

/// How far the story is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    /// Things happen.
    Troubles,
    /// No more; whoever lives comes to an end.
    Ends,
    /// It is looked at what is there.
    Audit,
}

/// The server's side of a story, as each of its processes finds it.
#[derive(Clone)]
struct Place {
    config: Config,
    registry: Registry,
    disk: Disk,
    durability: Durability,
    /// None where sessions are to be in memory alone.
    keeps: bool,
    /// Told to end.
    drain: Arc<Mutex<CancellationToken>>,
    dice: Arc<Mutex<Philox>>,
    tally: Arc<Tally>,
}

struct Story<'a> {
    sim: Sim<'a>,
    place: Place,
    dice: Philox,
    control: Control,
    lives: u32,
    deeds: BTreeMap<(Duration, u64), Deed>,
    count: u64,
    /// The disk as it was when the process before began.
    earlier: Option<Disk>,
}

/// When clients are to come to an end, and how many have.
#[derive(Clone, Default)]
struct Ends {
    stop: CancellationToken,
    stopped: Arc<AtomicU32>,
    audit: CancellationToken,
}

/// Lives the story of this seed.
///
/// # Errors
/// If it comes to no end.
pub fn live(seed: u64, stage: &Stage) -> Result<Sum, String> {
    let (tally, ends) = (Arc::<Tally>::default(), Ends::default());
    let (mut story, mut part) = (Story::begin(seed, stage, &tally, &ends)?, Part::Troubles);
    while !story.sim.step().map_err(|error| format!("{part:?}: {error}"))? {
        story.look();
        match part {
            Part::Troubles if is_enough(&tally.sum(), stage.flags.acts) || story.sim.elapsed() > ACTS_MAX => {
                story.end_troubles();
                ends.stop.cancel();
                part = Part::Ends;
            }
            // What is there is there after one death more, too.
            Part::Ends if ends.stopped.load(Ordering::Relaxed) == story.lives => {
                story.kill(false);
                ends.audit.cancel();
                part = Part::Audit;
            }
            Part::Troubles | Part::Ends | Part::Audit => {}
        }
    }
    Ok(tally.sum())
}

/// What comes after the first violation may be its consequence.
fn is_enough(sum: &Sum, acts: u64) -> bool {
    sum.acts >= acts || sum.found() > 0
}

fn client(number: u32) -> String {
    format!("client-{number}")
}

impl Place {
    fn draw(seed: u64, Stage { flags, registry }: &Stage, dice: &mut Philox, tally: Arc<Tally>) -> Self {
        let mut config = Config::default();
        config.server.drain_notice_ms = 5;
        config.server.drain_timeout_ms = 200;
        config.engine.batch_len_max = 4;
        config.sessions.reap_interval_ms = 50;
        if dice.below(2) == 0 {
            // Sessions leave memory all the time.
            (config.sessions.len_max, config.sessions.evict_idle_ms) = (2, 0);
        }
        let durability = if dice.below(2) == 0 { Durability::Process } else { Durability::Power };
        let lies = flags.control == Control::Lies;
        Self {
            config,
            registry: registry.clone(),
            disk: Disk::new(lies),
            durability: if lies { Durability::Power } else { durability },
            keeps: flags.control != Control::Forgetful,
            drain: Arc::default(),
            dice: Arc::new(Mutex::new(Philox::named(seed, "simulate.turns"))),
            tally,
        }
    }

    /// A server from its start to its end.
    async fn process(self) -> turmoil::Result {
        let drain = CancellationToken::new();
        *self.drain.lock() = drain.clone();
        let home = if self.keeps { Some(self.home()) } else { None };
        let home = match home.transpose() {
            Ok(home) => home,
            // It does not start, and will be started again.
            Err(_) if self.disk.is_ill() || self.disk.has_died() => return Ok(()),
            Err(error) => {
                self.tally.corrupt(&error);
                return Ok(());
            }
        };
        let (service, hands) = Service::by_hand(self.config, home)?;
        let (port, registry) = (Port::open().await?, self.registry);
        spawn_local(work(hands, self.dice));
        serve((port, None), Arc::new(service), async { Ok(registry) }, drain.cancelled_owned()).await?;
        Ok(())
    }

    fn home(&self) -> Result<Arc<dyn Home>, String> {
        let disk = self.disk.clone();
        let options = Options { durability: self.durability, cache_bytes: 1 << 20, len_max: 1_000, bytes_max: 1 << 30 };
        let home = Embedded::over(move || disk.medium(), options).map_err(|error| error.to_string())?;
        Ok(Arc::new(home))
    }
}

async fn lived(life: Life, ends: Ends, lists: Option<(Arc<Tally>, usize)>) -> turmoil::Result {
    let mut life = life.live(ends.stop).await;
    ends.stopped.fetch_add(1, Ordering::Relaxed);
    ends.audit.cancelled().await;
    life.audit().await;
    if let Some((tally, lives)) = lists {
        let listed = life.listed().await.ok_or("the sessions cannot be listed")?;
        tally.listed(listed, lives);
    }
    Ok(())
}

/// What the threads of a server do, in an order and at times that nobody knows.
async fn work(mut hands: Hands, dice: Arc<Mutex<Philox>>) {
    loop {
        let (pause, keeps) = {
            let mut dice = dice.lock();
            (dice.below(4) as u32, dice.below(2) == 0)
        };
        sleep(TICK * pause).await;
        if keeps {
            hands.keep()
        } else {
            hands.evaluate()
        };
    }
}

impl Story<'_> {
    fn begin(seed: u64, stage: &Stage, tally: &Arc<Tally>, ends: &Ends) -> Result<Self, String> {
        let Stage { flags, registry } = stage;
        let mut dice = Philox::named(seed, "simulate.story");
        let agent = &registry.get(&flags.model).map_err(|error| error.to_string())?.agent;
        let mut sim = Builder::new()
            .rng_seed(seed)
            .tick_duration(TICK)
            .simulation_duration(END)
            .min_message_latency(Duration::ZERO)
            .max_message_latency(TICK * (1 + dice.below(20) as u32))
            .enable_random_order()
            .build();
        let place = Place::draw(seed, stage, &mut dice, tally.clone());
        let on_stage = place.clone();
        sim.host(SERVER, move || on_stage.clone().process());
        let lives = 1 + dice.below(4) as u32;
        for number in 0..lives {
            let (agent, noise_is_wrong) = (agent.clone(), flags.control == Control::Noise);
            let lot = Lot { agent, model: flags.model.clone(), seed, number, call_max: CALL_MAX, noise_is_wrong };
            let life = Life::new(lot, dial(), tally.clone());
            // One of them counts, for all.
            let lists = (number == 0).then(|| (tally.clone(), lives as usize));
            sim.client(client(number), lived(life, ends.clone(), lists));
        }
        let mut story = Self { sim, place, dice, control: flags.control, lives, deeds: BTreeMap::new(), count: 0, earlier: None };
        story.plan(Duration::ZERO, Deed::Trouble);
        Ok(story)
    }

    fn plan(&mut self, after: Duration, deed: Deed) {
        self.count += 1;
        self.deeds.insert((self.sim.elapsed() + after, self.count), deed);
    }

    fn ms(&mut self, max: usize) -> Duration {
        TICK * (1 + self.dice.below(max) as u32)
    }

    /// Does what is to be done by now.
    fn look(&mut self) {
        if self.place.disk.has_died() {
            self.kill(self.place.durability == Durability::Power);
        }
        let starts = self.deeds.values().any(|deed| matches!(deed, Deed::Start));
        if !starts && !self.sim.is_host_running(SERVER) {
            let after = self.ms(TROUBLE_MS);
            self.plan(after, Deed::Start);
        }
        while let Some(entry) = self.deeds.first_entry()
            && entry.key().0 <= self.sim.elapsed()
        {
            match entry.remove() {
                Deed::Trouble => {
                    self.trouble();
                    let after = self.ms(PEACE_MS);
                    self.plan(after, Deed::Trouble);
                }
                Deed::Start => self.start(),
                Deed::Repair(number) => self.sim.repair(client(number), SERVER),
                Deed::Release(number) => self.sim.release(client(number), SERVER),
                Deed::Heal => self.place.disk.is(None),
            }
        }
    }

    fn trouble(&mut self) {
        let number = self.dice.below(self.lives as usize) as u32;
        let has_power = self.place.durability == Durability::Power;
        let trouble = match self.dice.below(9) {
            0 => Trouble::Killed,
            1 if has_power => Trouble::PowerGone,
            1 | 2 => Trouble::DiesInCommit,
            3 => Trouble::Drains,
            4 => Trouble::Partitioned(number),
            5 => Trouble::Held(number),
            6 => Trouble::DiskFull,
            7 => Trouble::DiskDoubtful,
            _ => Trouble::DiskBroken,
        };
        let lasts = self.ms(TROUBLE_MS);
        self.place.tally.troubled(trouble.word());
        match trouble {
            Trouble::Killed => self.kill(false),
            Trouble::PowerGone => self.kill(true),
            Trouble::DiesInCommit => self.place.disk.dies_after(1 + self.dice.below(OPS_MAX)),
            Trouble::Drains => self.place.drain.lock().cancel(),
            Trouble::Partitioned(number) => {
                self.sim.partition(client(number), SERVER);
                self.plan(lasts, Deed::Repair(number));
            }
            Trouble::Held(number) => {
                self.sim.hold(client(number), SERVER);
                self.plan(lasts, Deed::Release(number));
            }
            Trouble::DiskFull => self.ails(Ill::Full, lasts),
            Trouble::DiskBroken => self.ails(Ill::Broken, lasts),
            Trouble::DiskDoubtful => self.ails(Ill::Doubtful, lasts),
        }
    }

    fn ails(&mut self, ill: Ill, lasts: Duration) {
        self.place.disk.is(Some(ill));
        self.plan(lasts, Deed::Heal);
    }

    /// The end of the process, or of the machine.
    fn kill(&mut self, power: bool) {
        if power {
            self.place.disk.outlives_power(&mut self.dice);
        } else {
            self.place.disk.outlives_process();
        }
        self.sim.crash(SERVER);
    }

    fn start(&mut self) {
        if self.control == Control::Rollback {
            let now = self.place.disk.copy();
            if let Some(earlier) = self.earlier.replace(now) {
                self.place.disk.becomes(&earlier);
            }
        }
        self.sim.bounce(SERVER);
    }

    /// From now on all is well.
    fn end_troubles(&mut self) {
        self.deeds.retain(|_, deed| matches!(deed, Deed::Start));
        for number in 0..self.lives {
            self.sim.repair(client(number), SERVER);
            self.sim.release(client(number), SERVER);
        }
        self.place.disk.is(None);
    }
}

impl Trouble {
    /// The word in the sum.
    fn word(self) -> &'static str {
        match self {
            Self::Killed => "killed",
            Self::PowerGone => "without power",
            Self::DiesInCommit => "dead in the middle of a commit",
            Self::Drains => "drained",
            Self::Partitioned(_) => "partitioned",
            Self::Held(_) => "held up",
            Self::DiskFull => "disk full",
            Self::DiskBroken => "disk broken",
            Self::DiskDoubtful => "disk in doubt",
        }
    }
}

//! The step protocol as a model, every state of which is looked at: two clients of one session, each with observations of its own, two servers that may
//! die at any moment, a network that loses and repeats, and a store that compares and swaps. What the code does of it is in `serve/session/mod.rs` (enter), `serve/seat.rs`
//! (commit) and `serve/keeper.rs` (find).

use stateright::{Checker, Model, Property};
use std::collections::BTreeSet;

/// Steps of the episode.
const STEPS: u8 = 2;

/// Where the session stands: the last committed step, and whose observation it was for.
#[derive(Clone, Copy, Debug, Default, Hash, PartialEq, Eq, PartialOrd, Ord)]
struct Standing {
    step: u8,
    of: u8,
}

/// What is on its way. It may arrive never, or again and again.
#[derive(Clone, Copy, Debug, Hash, PartialEq, Eq, PartialOrd, Ord)]
enum Message {
    /// A client asks for a step, with an observation of its own.
    Asked { client: u8, step: u8 },
    /// The answer to it.
    Answered { client: u8, step: u8 },
    /// The session stands elsewhere.
    Refused { client: u8, committed: u8 },
}

#[derive(Clone, Debug, Default, Hash, PartialEq, Eq)]
struct Server {
    /// As it was last read or committed here.
    memory: Option<Standing>,
    /// An act in flight: whose, and from where it goes on.
    flight: Option<(u8, Standing)>,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq)]
struct Client {
    /// The step that it asks for.
    asks: u8,
    /// Steps whose answer it has.
    acked: [bool; STEPS as usize],
}

#[derive(Clone, Debug, Hash, PartialEq, Eq)]
struct State {
    store: Standing,
    servers: [Server; 2],
    clients: [Client; 2],
    network: BTreeSet<Message>,
    /// Whose observation each step was committed for, first.
    history: [Option<u8>; STEPS as usize],
    /// A step was committed a second time, for another.
    is_rewritten: bool,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq)]
enum Action {
    Send(u8),
    Arrive(usize, Message),
    Commit(usize),
    /// The commit is kept, and the server dies before it says so.
    CommitAndDie(usize),
    Die(usize),
    /// The session leaves memory.
    Spill(usize),
    Receive(Message),
}

/// What is wrong with a protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Flaw {
    /// Nothing.
    None,
    /// It answers before it keeps.
    AnswersFirst,
    /// It writes whatever is there.
    Blind,
    /// A session leaves memory, and a commit of before goes on in memory alone.
    Forgets,
}

struct Protocol(Flaw);

impl State {
    fn keep(&mut self, standing: Standing) {
        let first = self.history[usize::from(standing.step) - 1].get_or_insert(standing.of);
        self.is_rewritten |= *first != standing.of;
        self.store = standing;
    }
}

impl Protocol {
    /// `Session::enter`.
    fn arrive(&self, state: &mut State, server: usize, client: u8, step: u8) {
        let stored = state.store;
        let it = &mut state.servers[server];
        let stands = *it.memory.get_or_insert(stored);
        if step == stands.step && client == stands.of {
            state.network.insert(Message::Answered { client, step });
        } else if step == stands.step + 1 {
            if it.flight.is_none() {
                it.flight = Some((client, stands));
                if self.0 == Flaw::AnswersFirst {
                    state.network.insert(Message::Answered { client, step });
                }
            }
        } else {
            state.network.insert(Message::Refused { client, committed: stands.step });
        }
    }

    /// `Seat::commit`.
    fn commit(&self, state: &mut State, server: usize, dies: bool) {
        let Some((client, from)) = state.servers[server].flight.take() else { return };
        let next = Standing { step: from.step + 1, of: client };
        let swaps = self.0 == Flaw::Blind || state.store == from;
        if swaps {
            state.keep(next);
        }
        let goes_on = swaps || self.0 == Flaw::Forgets;
        state.servers[server].memory = (goes_on && !dies).then_some(next);
        if goes_on && !dies {
            state.network.insert(Message::Answered { client, step: next.step });
        }
    }
}

impl Model for Protocol {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        let client = Client { asks: 1, acked: [false; STEPS as usize] };
        vec![State {
            store: Standing::default(),
            servers: Default::default(),
            clients: [client.clone(), client],
            network: BTreeSet::new(),
            history: [None; STEPS as usize],
            is_rewritten: false,
        }]
    }

    fn actions(&self, state: &State, actions: &mut Vec<Action>) {
        actions.extend((0..2).filter(|client| state.clients[usize::from(*client)].asks <= STEPS).map(Action::Send));
        for message in &state.network {
            match message {
                Message::Asked { .. } => actions.extend((0..2).map(|server| Action::Arrive(server, *message))),
                Message::Answered { .. } | Message::Refused { .. } => actions.push(Action::Receive(*message)),
            }
        }
        for (index, server) in state.servers.iter().enumerate() {
            if server.flight.is_some() {
                actions.extend([Action::Commit(index), Action::CommitAndDie(index)]);
            }
            if server.flight.is_none() && server.memory.is_some() {
                actions.push(Action::Spill(index));
            }
            actions.push(Action::Die(index));
        }
    }

    fn next_state(&self, last: &State, action: Action) -> Option<State> {
        let mut state = last.clone();
        match action {
            Action::Send(client) => {
                state.network.insert(Message::Asked { client, step: state.clients[usize::from(client)].asks });
            }
            Action::Arrive(server, Message::Asked { client, step }) => self.arrive(&mut state, server, client, step),
            Action::Commit(server) => self.commit(&mut state, server, false),
            Action::CommitAndDie(server) => self.commit(&mut state, server, true),
            Action::Die(server) => state.servers[server] = Server::default(),
            Action::Spill(server) => state.servers[server].memory = None,
            Action::Receive(Message::Answered { client, step }) => {
                let client = &mut state.clients[usize::from(client)];
                if step == client.asks {
                    client.acked[usize::from(step) - 1] = true;
                    client.asks += 1;
                }
            }
            Action::Receive(Message::Refused { client, committed }) => {
                let client = &mut state.clients[usize::from(client)];
                client.asks = client.asks.max(committed + 1);
            }
            Action::Arrive(..) | Action::Receive(Message::Asked { .. }) => return None,
        }
        (state != *last).then_some(state)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always("no step is given twice", |_, state: &State| {
                !state.is_rewritten && (0..usize::from(STEPS)).all(|step| !state.clients.iter().all(|client| client.acked[step]))
            }),
            Property::always("what was told is kept", |_, state: &State| {
                let kept = |(client, step): (usize, usize)| {
                    !state.clients[client].acked[step] || state.history[step] == Some(client as u8) && usize::from(state.store.step) > step
                };
                (0..2).flat_map(|client| (0..usize::from(STEPS)).map(move |step| (client, step))).all(kept)
            }),
            Property::sometimes("both act", |_, state: &State| state.clients.iter().all(|client| client.acked.contains(&true))),
            Property::sometimes("the episode ends", |_, state: &State| state.store.step == STEPS),
        ]
    }
}

#[test]
fn no_state_of_the_protocol_loses_an_act() {
    let checker = Protocol(Flaw::None).checker().threads(2).spawn_bfs().join();
    checker.assert_properties();
    assert!(checker.is_done() && checker.unique_state_count() > 10_000, "{} states", checker.unique_state_count());
}

/// Each flaw is found.
#[test]
fn a_flawed_protocol_is_found_out() {
    for flaw in [Flaw::AnswersFirst, Flaw::Blind, Flaw::Forgets] {
        let checker = Protocol(flaw).checker().threads(2).spawn_bfs().join();
        let found = ["no step is given twice", "what was told is kept"].into_iter().filter(|name| checker.discovery(name).is_some());
        assert!(found.count() > 0, "{flaw:?}");
    }
}

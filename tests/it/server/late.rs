//! Copies that a network delivers twice, late and out of order: the committed history is that of a client whose network does not.

use super::*;
use ada_diffuser::model::{
    agent::{Agent, Episode, Observation},
    noise::Philox,
};

/// A message as it was sent, to be delivered again.
#[derive(Clone)]
enum Message {
    Act { episode: u64, step: u64, state: [f32; 4] },
    Reset { episode: u64, seed: u64, request_id: String },
}

/// What became of it: the actions of an act, the episode and step after a reset, or the word of its refusal.
#[derive(Debug, PartialEq)]
enum Outcome {
    Acted(Vec<Vec<f32>>),
    Stands(u64, u64),
    Refused(String),
}

struct Client {
    server: Running,
    agent: AgentClient<Channel>,
    id: String,
}

impl Client {
    async fn deliver(&self, message: &Message, by_grpc: bool) -> Outcome {
        if by_grpc { self.grpc(message).await } else { self.http(message).await }
    }

    async fn grpc(&self, message: &Message) -> Outcome {
        let (mut agent, session_id) = (self.agent.clone(), self.id.clone());
        let outcome = match message.clone() {
            Message::Act { episode, step, state } => {
                let request = pb::ActRequest { episode: Some(episode), ..act(&session_id, step, &state) };
                agent.act(request).await.map(|answer| {
                    let actions = answer.into_inner().actions.unwrap();
                    Outcome::Acted(actions.values.chunks(actions.columns as usize).map(<[f32]>::to_vec).collect())
                })
            }
            Message::Reset { episode, seed, request_id } => {
                let (seed, episode) = (Some(seed), Some(episode));
                let request = pb::ResetSessionRequest { session_id, seed, keep_history: false, request_id, episode };
                agent.reset_session(request).await.map(|answer| {
                    let session = answer.into_inner().session.unwrap();
                    Outcome::Stands(session.episode, session.committed_step)
                })
            }
        };
        outcome.unwrap_or_else(|status| Outcome::Refused(failure(&status).1))
    }

    async fn http(&self, message: &Message) -> Outcome {
        let path = format!("/v1/sessions/{}", self.id);
        let (path, body) = match message {
            Message::Act { episode, step, state } => {
                (path + "/act", json!({"episode": episode, "step": step, "observation": {"state": state}}))
            }
            Message::Reset { episode, seed, request_id } => {
                (path + "/reset", json!({"episode": episode, "seed": seed, "request_id": request_id}))
            }
        };
        let reply = self.server.post(&path, &body).await;
        if reply.status != 200 {
            return Outcome::Refused(reply.reason());
        }
        let (json, number) = (reply.json(), |value: &Value| value.as_u64().unwrap());
        match message {
            Message::Act { .. } => Outcome::Acted(serde_json::from_value(json["actions"].clone()).unwrap()),
            Message::Reset { .. } => Outcome::Stands(number(&json["session"]["episode"]), number(&json["session"]["committed_step"])),
        }
    }
}

/// What the session must be: the same episode without a network.
struct Oracle {
    agent: Agent,
    episode: Episode,
    number: u64,
    step: u64,
    last: Vec<Vec<f32>>,
}

impl Oracle {
    fn take(&mut self, message: &Message) -> Outcome {
        match message {
            Message::Act { state, .. } => {
                let seen = Observation { state: state.to_vec(), ..Observation::default() };
                let (episode, chunk) = self.agent.act(&self.episode, &seen).unwrap();
                (self.episode, self.step, self.last) = (episode, self.step + 1, chunk.actions.clone());
                Outcome::Acted(chunk.actions)
            }
            Message::Reset { seed, .. } => {
                self.episode = self.agent.reset(&self.episode, *seed, false).unwrap();
                (self.number, self.step) = (self.number + 1, 0);
                Outcome::Stands(self.number, 0)
            }
        }
    }

    /// What a copy that comes now may be answered.
    fn allows(&self, late: &Message, outcome: &Outcome) -> bool {
        match (late, outcome) {
            (Message::Act { episode, step, .. }, Outcome::Acted(actions)) => {
                (*episode, *step) == (self.number, self.step) && *actions == self.last
            }
            (Message::Act { episode, .. }, Outcome::Refused(word)) if *episode != self.number => word == "EPISODE_OVER",
            (Message::Act { step, .. }, Outcome::Refused(word)) => *step < self.step && word == "STEP_OUT_OF_ORDER",
            (Message::Reset { .. }, Outcome::Stands(episode, step)) => (*episode, *step) == (self.number, self.step),
            (Message::Reset { .. }, Outcome::Refused(word)) => word == "EPISODE_OVER",
            _ => false,
        }
    }
}

/// A delayed copy of step 1 of the old episode was taken for step 1 of the new one, and one of a reset undid 24 committed acts.
/// `ADA_LATE=100000` delivers so many messages.
#[tokio::test(flavor = "multi_thread")]
async fn late_copies_change_nothing() {
    let count: usize = std::env::var("ADA_LATE").map_or(4_000, |count| count.parse().unwrap());
    let server = start(|_| {}).await;
    let id = server.open(json!({"model": "tiny", "seed": 1})).await;
    let client = Client { agent: server.agent().await, server, id };
    let agent = checkpoint::load(&models_dir().join("tiny")).unwrap();
    let episode = agent.open(1, &agent.config().defaults.sampler).unwrap();
    let mut oracle = Oracle { agent, episode, number: 0, step: 0, last: Vec::new() };
    let (mut rng, mut sent, mut late): (_, Vec<Message>, Vec<Message>) = (Philox::new(5), Vec::new(), Vec::new());
    let mut delivered = 0;
    while delivered < count {
        let message = if oracle.step > 0 && rng.below(12) == 0 {
            Message::Reset { episode: oracle.number, seed: rng.below(1000) as u64, request_id: format!("reset-{delivered}") }
        } else {
            Message::Act { episode: oracle.number, step: oracle.step + 1, state: [0; 4].map(|_| rng.normal()) }
        };
        let by_grpc = rng.below(2) == 0;
        let expected = oracle.take(&message);
        // Now and then two copies at once, by both faces; both are answered, and one act is computed.
        if rng.below(4) == 0 {
            let both = tokio::join!(client.grpc(&message), client.http(&message));
            assert_eq!((&both.0, &both.1), (&expected, &expected));
            delivered += 1;
        } else {
            assert_eq!(client.deliver(&message, by_grpc).await, expected);
        }
        delivered += 1;
        sent.push(message);
        // The network keeps copies of what it has carried, and lets them go when it likes.
        if rng.below(3) == 0 {
            late.push(sent[sent.len() - 1 - rng.below(sent.len().min(40))].clone());
        }
        while !late.is_empty() && rng.below(3) == 0 {
            let copy = late.swap_remove(rng.below(late.len()));
            let outcome = client.deliver(&copy, !by_grpc).await;
            assert!(oracle.allows(&copy, &outcome), "{outcome:?} at episode {}, step {}", oracle.number, oracle.step);
            delivered += 1;
        }
    }
    let session = client.server.get(&format!("/v1/sessions/{}", client.id)).await.json()["session"].clone();
    assert_eq!((session["episode"].as_u64(), session["committed_step"].as_u64()), (Some(oracle.number), Some(oracle.step)));
}

/// An open whose answer was lost was opened twice.
#[tokio::test(flavor = "multi_thread")]
async fn an_open_by_name_is_opened_once() {
    let server = start(|_| {}).await;
    let named = json!({"model": "tiny", "seed": 3, "request_id": "robot-7/1"});
    let id = server.open(named.clone()).await;
    server.act(&id, 1, &STATE).await;
    let request = pb::OpenSessionRequest { model: "tiny".into(), seed: Some(3), request_id: "robot-7/1".into(), ..Default::default() };
    let again = server.agent().await.open_session(request).await.unwrap().into_inner().session.unwrap();
    assert_eq!((again.session_id.as_str(), again.committed_step), (id.as_str(), 1), "the same session, where it stands");
    let other = server.post("/v1/sessions", &json!({"model": "slow", "request_id": "robot-7/1"})).await;
    assert_eq!((other.status, other.reason().as_str(), other.json()["field"].as_str()), (400, "REQUEST_INVALID", Some("request_id")));
    server.http("DELETE", &format!("/v1/sessions/{id}"), "").await;
    assert_ne!(server.open(named).await, id, "a name is free again when its session has ended");
    for wrong in ["a b", "\u{e9}", &"x".repeat(65)] {
        assert_eq!(server.post("/v1/sessions", &json!({"request_id": wrong})).await.json()["field"], "request_id", "{wrong}");
    }
    // Of many at once.
    let opening = json!({"model": "tiny", "request_id": "at-once"});
    let opened = futures_util::future::join_all((0..16).map(|_| server.open(opening.clone()))).await;
    assert!(opened.iter().all(|id| *id == opened[0]), "{opened:?}");
    assert_eq!(server.get("/v1/sessions").await.json()["sessions"].as_array().unwrap().len(), 2);
}

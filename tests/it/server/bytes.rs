//! The same seed and the same observations give the same bytes, whoever asks, over whichever face, in whatever company, before and after a restart.

use super::*;

const SEEDS: usize = 64;
const STEPS: u64 = 4;

/// What was seen and done at a step, different for every seed and step; every kind of missing part occurs, and so do acts in the place of
/// the one before.
pub fn observation(seed: usize, step: u64) -> pb::Observation {
    let wave = |i: usize| ((seed * 31 + step as usize * 7 + i * 3) as f32 * 0.37).sin();
    let vector = |from: usize, len: usize| pb::Vector { values: (from..from + len).map(wave).collect() };
    let executed = pb::Executed {
        state: None,
        action: seed.is_multiple_of(2).then(|| vector(10, 2)),
        reward: seed.is_multiple_of(3).then(|| wave(20)),
    };
    let executed = if step > 1 && !seed.is_multiple_of(5) { vec![executed] } else { vec![] };
    let nothing_executed = executed.is_empty() && seed.is_multiple_of(10);
    pb::Observation { state: vector(0, 4).values, executed, nothing_executed, context: None }
}

fn request(id: &str, seed: usize, step: u64) -> pb::ActRequest {
    let observation = Some(observation(seed, step));
    pb::ActRequest { session_id: id.to_owned(), step, observation, want_planned_states: true, ..Default::default() }
}

fn request_json(id: &str, seed: usize, step: u64) -> Value {
    let pb::Observation { state, executed, nothing_executed, context: _ } = observation(seed, step);
    let executed: Vec<_> = executed
        .into_iter()
        .map(|pb::Executed { state, action, reward }| json!({"state": state.map(|v| v.values), "action": action.map(|v| v.values), "reward": reward}))
        .collect();
    let observation = json!({"state": state, "executed": executed, "nothing_executed": nothing_executed});
    json!({"session_id": id, "step": step, "observation": observation, "want_planned_states": true})
}

/// Everything numeric in an answer, by its bits.
pub fn bits(answer: &pb::ActResponse) -> Vec<u32> {
    let floats = [
        &answer.actions.as_ref().unwrap().values,
        &answer.planned_states.as_ref().unwrap().values,
        &answer.latent_mean,
        &answer.latent_log_var,
        &answer.predicted_state,
    ];
    let floats = floats.into_iter().flatten().map(|value| value.to_bits());
    floats.chain([answer.evaluations, answer.passes, answer.start as u32, answer.renoised_rungs]).collect()
}

pub fn bits_json(answer: &Value) -> Vec<u32> {
    fn collect(value: &Value, bits: &mut Vec<u32>) {
        match value {
            Value::Array(values) => values.iter().for_each(|value| collect(value, bits)),
            value => bits.push((value.as_f64().unwrap() as f32).to_bits()),
        }
    }
    let mut bits = Vec::new();
    for field in ["actions", "planned_states", "latent_mean", "latent_log_var", "predicted_state"] {
        collect(&answer[field], &mut bits);
    }
    let start = ["", "cold", "warm", "renoised"].iter().position(|word| answer["start"] == *word).unwrap();
    let count = |field: &str| answer[field].as_u64().unwrap() as u32;
    bits.extend([count("evaluations"), count("passes"), start as u32, count("renoised_rungs")]);
    bits
}

/// Sessions with seeds 0 to 63 and options that use all noise there is.
async fn open_all(server: &Running) -> Vec<String> {
    let mut ids = Vec::new();
    for seed in 0..SEEDS {
        let mut options =
            json!({"streaming": seed % 4 > 0, "action_horizon": 1 + seed % 2, "eta": 0.7, "temperature": 1, "latent": "sample"});
        (options["sub_steps"], options["picard_window"]) = (json!(1 + seed % 3), json!(1 + seed / 3 % 3));
        ids.push(server.open(json!({"seed": seed, "options": options})).await);
    }
    ids
}

async fn one_by_one(server: &Running, seeds: usize) -> Vec<Vec<u32>> {
    let (ids, mut agent) = (open_all(server).await, server.agent().await);
    let mut all = Vec::new();
    for step in 1..=STEPS {
        for (seed, id) in ids.iter().enumerate().take(seeds) {
            all.push(bits(&agent.act(request(id, seed, step)).await.unwrap().into_inner()));
        }
    }
    all
}

async fn one_by_one_rest(server: &Running) -> Vec<Vec<u32>> {
    let ids = open_all(server).await;
    let mut all = Vec::new();
    for step in 1..=STEPS {
        for (seed, id) in ids.iter().enumerate() {
            let reply = server.post(&format!("/v1/sessions/{id}/act"), &request_json(id, seed, step)).await;
            assert_eq!(reply.status, 200, "{reply:?}");
            all.push(bits_json(&reply.json()));
        }
    }
    all
}

async fn in_batches(server: &Running) -> Vec<Vec<u32>> {
    let (ids, mut agent) = (open_all(server).await, server.agent().await);
    let mut all = Vec::new();
    for step in 1..=STEPS {
        let acts = ids.iter().enumerate().map(|(seed, id)| request(id, seed, step)).collect();
        for result in agent.act_batch(pb::ActBatchRequest { acts }).await.unwrap().into_inner().results {
            match result.result.unwrap() {
                pb::act_result::Result::Response(answer) => all.push(bits(&answer)),
                pb::act_result::Result::Error(error) => panic!("{error:?}"),
            }
        }
    }
    all
}

async fn in_batches_rest(server: &Running) -> Vec<Vec<u32>> {
    let ids = open_all(server).await;
    let mut all = Vec::new();
    for step in 1..=STEPS {
        let acts: Vec<_> = ids.iter().enumerate().map(|(seed, id)| request_json(id, seed, step)).collect();
        let reply = server.post("/v1/act:batch", &json!({"acts": acts})).await.json();
        all.extend(reply["results"].as_array().unwrap().iter().map(|result| bits_json(&result["response"])));
    }
    all
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_bytes_everywhere() {
    let one_worker = |config: &mut Config| {
        config.engine.workers = 1;
        config.engine.batch_len_max = SEEDS;
    };
    let server = start(one_worker).await;
    let expected = one_by_one(&server, SEEDS).await;
    let differ: std::collections::HashSet<_> = expected.iter().collect();
    assert_eq!(differ.len(), expected.len(), "every act is another one");
    assert!(one_by_one_rest(&server).await == expected, "REST");
    assert!(in_batches(&server).await == expected, "a batch of 64");
    assert!(in_batches_rest(&server).await == expected, "a batch of 64 over REST");
    drop(server);
    let restarted = start(one_worker).await;
    assert!(in_batches(&restarted).await == expected, "after a restart");
    drop(restarted);
    let two = start(|config| config.engine.workers = 2).await;
    assert!(in_batches(&two).await == expected, "two workers, batches of 32");
    assert!(one_by_one(&two, 8).await[..8] == expected[..8], "two workers, alone");
}

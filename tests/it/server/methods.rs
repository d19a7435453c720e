//! What goes with some methods alone: rows that are evaluated at once, what is told, the true context. Each is described, taken where it belongs, and
//! refused elsewhere with the reason, over both faces alike.

use super::*;
use ada_diffuser::model::{
    Networks,
    checkpoint::{FORMAT_VERSION, Manifest, Provenance, TensorDigest},
    method::{Guide, LatentSource, Told, TrueFuture},
    nn::params::Params,
    normalizer::Affine,
};
use std::collections::BTreeMap;

/// A directory with one model: `tiny` with another method and fresh weights. Written by hand: the program tries an act of what it writes, which an
/// oracle cannot do without its context.
pub fn fresh(adjust: impl FnOnce(&mut ModelConfig)) -> tempfile::TempDir {
    let mut config = checkpoint::load(&models_dir().join("tiny")).unwrap().config().clone();
    adjust(&mut config);
    config.check().unwrap();
    let params = Params::fresh(7);
    Networks::new(config.layout, &config.method, &params).unwrap();
    let tensors: BTreeMap<_, _> = params.vars().into_iter().map(|(name, var)| (name, var.as_tensor().clone())).collect();
    let weights = safetensors::serialize(&tensors, None).unwrap();
    let views = SafeTensors::deserialize(&weights).unwrap().tensors();
    let digests = views.into_iter().map(|(name, view)| (name, TensorDigest { shape: view.shape().to_vec(), sha256: sha256(view.data()) }));
    let files = [("config.json", serde_json::to_vec(&config).unwrap()), ("model.safetensors", weights.clone())];
    let manifest = Manifest {
        format_version: FORMAT_VERSION,
        files: files.iter().map(|(name, bytes)| ((*name).to_owned(), sha256(bytes))).collect(),
        tensors: digests.collect(),
        provenance: Provenance::default(),
    };
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("fresh");
    fs::create_dir(&model).unwrap();
    files.iter().for_each(|(name, bytes)| fs::write(model.join(name), bytes).unwrap());
    fs::write(model.join("manifest.json"), serde_json::to_vec(&manifest).unwrap()).unwrap();
    dir
}

pub async fn serve(dir: &tempfile::TempDir) -> Running {
    start(|config| {
        config.models.dir = dir.path().to_owned();
        config.models.default = "fresh".to_owned();
        config.engine.batch_len_max = 4;
    })
    .await
}

/// Opens a session with these options on both faces, or is refused with the same words by both.
async fn open(server: &Running, grpc: pb::SamplerOptions, http: Value) -> Result<[String; 2], (String, String)> {
    let request = pb::OpenSessionRequest { seed: Some(3), options: Some(grpc), ..Default::default() };
    let by_grpc = server.agent().await.open_session(request).await;
    let by_http = server.post("/v1/sessions", &json!({"seed": 3, "options": http})).await;
    match by_grpc {
        Ok(opened) => {
            let session = opened.into_inner().session.unwrap();
            assert_eq!(by_http.status, 201, "{by_http:?}");
            Ok([session.session_id, by_http.json()["session"]["session_id"].as_str().unwrap().to_owned()])
        }
        Err(refused) => Err(alike(&refused, &by_http, "OPTIONS_INVALID")),
    }
}

/// Field and reason of what both faces refuse.
pub fn alike(grpc: &Status, http: &Reply, word: &str) -> (String, String) {
    assert_eq!((failure(grpc), (http.status, http.reason().as_str())), ((Code::InvalidArgument, word.into()), (400, word)), "{grpc:?}");
    let (field, problem) = (trailer(grpc, "ada-field").unwrap(), http.json());
    assert_eq!((problem["field"].as_str(), problem["detail"].as_str()), (Some(field.as_str()), Some(grpc.message())));
    (field.clone(), grpc.message().strip_prefix(&format!("{field}: ")).unwrap().to_owned())
}

/// The same act on both faces, answered with the same numbers or refused with the same words; the answer over REST.
async fn act_on(server: &Running, ids: &[String; 2], step: u64, context: Option<&[&[f32]]>) -> Result<Value, (String, String)> {
    let matrix = |rows: &[&[f32]]| pb::Matrix {
        values: rows.concat(),
        rows: rows.len() as u32,
        columns: rows.first().map_or(0, |row| row.len() as u32),
    };
    let mut request = act(&ids[0], step, &STATE);
    request.observation.as_mut().unwrap().context = context.map(matrix);
    let grpc = server.agent().await.act(request).await;
    let body = json!({"step": step, "observation": {"state": STATE, "context": context}});
    let http = server.post(&format!("/v1/sessions/{}/act", ids[1]), &body).await;
    match grpc {
        Ok(answer) => {
            let (answer, json) = (answer.into_inner(), http.json());
            assert_eq!(http.status, 200, "{http:?}");
            let values: Vec<f32> = json["actions"]
                .as_array()
                .unwrap()
                .iter()
                .flat_map(|row| serde_json::from_value::<Vec<f32>>(row.clone()).unwrap())
                .collect();
            assert_eq!(answer.actions.unwrap().values, values);
            assert_eq!(
                (json["evaluations"].as_u64(), json["passes"].as_u64()),
                (Some(answer.evaluations.into()), Some(answer.passes.into()))
            );
            let worth = |field: &str| json.get(field).map(|value| value.as_f64().unwrap() as f32);
            assert_eq!((worth("value"), worth("value_spread")), (answer.value, answer.value_spread));
            Ok(json)
        }
        Err(refused) => Err(alike(&refused, &http, "OBSERVATION_INVALID")),
    }
}

fn goal(values: &[f32]) -> Option<pb::Vector> {
    Some(pb::Vector { values: values.to_vec() })
}

/// Without a guide, without anything to be told, and without an oracle's network.
#[tokio::test(flavor = "multi_thread")]
async fn a_plain_model_refuses_them_with_the_reason() {
    let server = start(|_| {}).await;
    let none = pb::SamplerOptions::default;
    for (grpc, http, field, reason) in [
        (pb::SamplerOptions { guidance_scale: Some(1.0), ..none() }, json!({"guidance_scale": 1}), "guidance_scale", "no guide"),
        (pb::SamplerOptions { guidance_samples: Some(2), ..none() }, json!({"guidance_samples": 2}), "guidance_samples", "guidance_scale"),
        (pb::SamplerOptions { candidates: Some(2), ..none() }, json!({"candidates": 2}), "candidates", "nothing could choose"),
        (pb::SamplerOptions { candidates: Some(0), ..none() }, json!({"candidates": 0}), "candidates", "outside 1..=1024"),
        (pb::SamplerOptions { pick_temperature: Some(-1.0), ..none() }, json!({"pick_temperature": -1}), "pick_temperature", "outside"),
        (
            pb::SamplerOptions { told_return: Some(1.5), ..none() },
            json!({"told_return": 1.5}),
            "told_return",
            "not trained to be told a return",
        ),
        (
            pb::SamplerOptions { told_goal: goal(&[0.5]), ..none() },
            json!({"told_goal": [0.5]}),
            "told_goal",
            "not trained to be told a goal",
        ),
        (pb::SamplerOptions { told_goal: goal(&[]), ..none() }, json!({"told_goal": []}), "told_goal", "not trained to be told a goal"),
        (
            pb::SamplerOptions { free_guidance_scale: Some(2.0), ..none() },
            json!({"free_guidance_scale": 2}),
            "free_guidance_scale",
            "nothing is told",
        ),
        (pb::SamplerOptions { picard_window: Some(0), ..none() }, json!({"picard_window": 0}), "picard_window", "outside 1..=4096"),
        (
            pb::SamplerOptions { picard_tolerance: Some(-0.5), ..none() },
            json!({"picard_tolerance": -0.5}),
            "picard_tolerance",
            "not 0 or above",
        ),
    ] {
        let (at, why) = open(&server, grpc, http).await.unwrap_err();
        assert_eq!(at, format!("options.{field}"));
        assert!(why.contains(reason), "{field}: {why}");
    }
    let ids = open(&server, none(), json!({})).await.unwrap();
    let (at, why) = act_on(&server, &ids, 1, Some(&[&[0.0, 0.0]])).await.unwrap_err();
    assert!(at == "observation.context" && why.contains("leave the field out"), "{at}: {why}");
    assert_eq!(act_on(&server, &ids, 1, None).await.unwrap()["step"], 1, "nothing is lost");
    let tiny = server.get("/v1/models/tiny").await.json()["model"].clone();
    assert_eq!((&tiny["told"], &tiny["guide"], tiny.get("context"), tiny.get("returns")), (&json!([]), &json!(false), None, None));
}

/// Of JSON alone: each field is read as strictly as the others.
#[tokio::test(flavor = "multi_thread")]
async fn json_of_the_wrong_shape_is_named() {
    let server = start(|_| {}).await;
    for (body, field) in [
        (json!({"told_goal": 0.5}), "options.told_goal"),
        (json!({"told_goal": [0.5, "x"]}), "options.told_goal[1]"),
        (json!({"told_goal": {"values": [0.5]}}), "options.told_goal"),
        (json!({"told_return": "much"}), "options.told_return"),
        (json!({"candidates": 1.5}), "options.candidates"),
        (json!({"picard_window": -1}), "options.picard_window"),
        (json!({"guidance": 1}), "options.guidance"),
    ] {
        let reply = server.post("/v1/sessions", &json!({"options": body})).await;
        assert_eq!((reply.reason().as_str(), reply.json()["field"].as_str()), ("OPTIONS_INVALID", Some(field)), "{reply:?}");
    }
    let id = server.open(json!({"options": {"told_return": null, "told_goal": null, "picard_window": 2.0}})).await;
    let options = server.get(&format!("/v1/sessions/{id}")).await.json()["session"]["options"].clone();
    assert_eq!((&options["told_return"], &options["told_goal"], &options["picard_window"]), (&json!(null), &json!(null), &json!(2)));
    for (context, field) in [
        (json!([0.5]), "observation.context[0]"),
        (json!([[0.5, null]]), "observation.context[0][1]"),
        (json!({"values": []}), "observation.context"),
    ] {
        let body = json!({"step": 1, "observation": {"state": STATE, "context": context}});
        let reply = server.post(&format!("/v1/sessions/{id}/act"), &body).await;
        assert_eq!((reply.reason().as_str(), reply.json()["field"].as_str()), ("OBSERVATION_INVALID", Some(field)), "{reply:?}");
    }
}

/// Several rows at once: as many evaluations or more, in fewer forwards, and it says how many.
#[tokio::test(flavor = "multi_thread")]
async fn rows_are_evaluated_at_once() {
    let server = start(|_| {}).await;
    let cold = |window: u32| pb::SamplerOptions { streaming: Some(false), picard_window: Some(window), ..Default::default() };
    let mut told = Vec::new();
    for window in [1, 4] {
        let ids = open(&server, cold(window), json!({"streaming": false, "picard_window": window})).await.unwrap();
        let answer = act_on(&server, &ids, 1, None).await.unwrap();
        let summary = server.agent().await.get_session(pb::GetSessionRequest { session_id: ids[0].clone() }).await.unwrap();
        assert_eq!(summary.into_inner().session.unwrap().options.unwrap().picard_window, Some(window));
        assert_eq!(server.get(&format!("/v1/sessions/{}", ids[1])).await.json()["session"]["options"]["picard_window"], window);
        told.push([&answer["evaluations"], &answer["passes"]].map(|count| count.as_u64().unwrap()));
    }
    let [one_by_one, at_once] = [told[0], told[1]];
    assert_eq!(one_by_one, [8, 8]);
    assert!(at_once[0] >= at_once[1] && at_once[0] > 8 && at_once[1] <= 8, "{at_once:?}");
}

/// A model that is told a return and a goal: all of it or nothing, and what is told changes what is done.
#[tokio::test(flavor = "multi_thread")]
async fn what_is_wanted_is_told() {
    let server = serve(&fresh(|config| {
        config.method.told = vec![Told::Return, Told::Goal { columns: vec![0, 2] }];
        config.units.returns = Some(Affine { mean: vec![-2.0], std: vec![0.5] });
    }))
    .await;
    let model = server.get("/v1/models/fresh").await.json()["model"].clone();
    assert_eq!(model["told"], json!([{"kind": "return", "columns": []}, {"kind": "goal", "columns": [0, 2]}]));
    assert_eq!(model["returns"], json!({"mean": -2.0, "std": 0.5}));
    let grpc = server.models().await.get(pb::GetModelRequest { model: "fresh".into() }).await.unwrap().into_inner().model.unwrap();
    let kinds: Vec<_> = grpc.told.iter().map(|told| (told.kind(), told.columns.clone())).collect();
    assert_eq!(kinds, [(pb::ToldKind::Return, vec![]), (pb::ToldKind::Goal, vec![0, 2])]);
    assert_eq!((grpc.returns, grpc.guide, grpc.context), (Some(pb::Returns { mean: -2.0, std: 0.5 }), false, None));
    let told = |told_return, told_goal, free_guidance_scale| pb::SamplerOptions {
        told_return,
        told_goal,
        free_guidance_scale,
        ..Default::default()
    };
    for (grpc, http, field, reason) in [
        (told(Some(1.0), None, None), json!({"told_return": 1}), "options.told_goal", "is missing"),
        (told(None, goal(&[0.0, 0.0]), None), json!({"told_goal": [0, 0]}), "options.told_return", "is missing"),
        (
            told(Some(1.0), goal(&[]), None),
            json!({"told_return": 1, "told_goal": []}),
            "options.told_goal",
            "has 0 values, the model takes 2",
        ),
        (told(Some(1.0), goal(&[0.5]), None), json!({"told_return": 1, "told_goal": [0.5]}), "options.told_goal", "has 1 values"),
    ] {
        let (at, why) = open(&server, grpc, http).await.unwrap_err();
        assert!(at == field && why.contains(reason), "{at}: {why}");
    }
    let mut actions = Vec::new();
    for (grpc, http, rows) in [
        (told(None, None, None), json!({}), 1),
        (told(Some(-1.5), goal(&[0.5, 0.25]), None), json!({"told_return": -1.5, "told_goal": [0.5, 0.25]}), 1),
        (told(Some(-1.5), goal(&[0.5, 1.0]), None), json!({"told_return": -1.5, "told_goal": [0.5, 1]}), 1),
        (told(Some(-1.5), goal(&[0.5, 1.0]), Some(3.0)), json!({"told_return": -1.5, "told_goal": [0.5, 1], "free_guidance_scale": 3}), 2),
    ] {
        let ids = open(&server, grpc.clone(), http).await.unwrap();
        let answer = act_on(&server, &ids, 1, None).await.unwrap();
        let counted = [&answer["evaluations"], &answer["passes"]].map(|count| count.as_u64().unwrap());
        assert_eq!(counted, [8 * rows, 8], "each is evaluated without it as well, where it is doubted");
        assert!(answer.get("value").is_none(), "nothing judges it");
        let summary = server.agent().await.get_session(pb::GetSessionRequest { session_id: ids[0].clone() }).await.unwrap();
        let options = summary.into_inner().session.unwrap().options.unwrap();
        assert_eq!((options.told_return, options.told_goal), (grpc.told_return, grpc.told_goal), "absent where nothing is told");
        actions.push(answer["actions"].to_string());
    }
    let differ: std::collections::HashSet<_> = actions.iter().collect();
    assert_eq!(differ.len(), 4, "{actions:?}");
}

/// One with a guide may be led by it and choose among candidates, and says what its plan is worth.
#[tokio::test(flavor = "multi_thread")]
async fn a_guide_leads_and_chooses() {
    let server = serve(&fresh(|config| {
        config.method.guide = Some(Guide::DecoderReturn);
        config.units.returns = Some(Affine { mean: vec![-2.0], std: vec![0.5] });
    }))
    .await;
    assert_eq!(server.get("/v1/models/fresh").await.json()["model"]["guide"], true);
    let cold = |candidates: u32, guidance_scale: f32| {
        let (streaming, temperature) = (Some(false), Some(1.0));
        let grpc = pb::SamplerOptions {
            streaming,
            temperature,
            candidates: Some(candidates),
            guidance_scale: Some(guidance_scale),
            ..Default::default()
        };
        (grpc, json!({"streaming": false, "temperature": 1, "candidates": candidates, "guidance_scale": guidance_scale}))
    };
    let kept = pb::SamplerOptions { candidates: Some(2), ..Default::default() };
    let (at, why) = open(&server, kept, json!({"candidates": 2})).await.unwrap_err();
    assert!(at == "options.candidates" && why.contains("streaming = false"), "{at}: {why}");
    let mut told = Vec::new();
    for (candidates, scale) in [(1, 0.0), (6, 0.0), (1, 500.0), (1, 1e-6)] {
        let (grpc, http) = cold(candidates, scale);
        let ids = open(&server, grpc, http).await.unwrap();
        let answer = act_on(&server, &ids, 1, None).await.unwrap();
        let counted = [&answer["evaluations"], &answer["passes"]].map(|count| count.as_u64().unwrap());
        assert_eq!(counted, [8 * u64::from(candidates), 8], "rows beyond a batch of 4 are a tick of their own");
        told.push([&answer["value"], &answer["value_spread"]].map(Value::as_f64));
        let summary = server.get(&format!("/v1/sessions/{}", ids[1])).await.json()["session"]["options"].clone();
        let given = summary["guidance_scale"].as_f64().map(|scale| scale as f32);
        assert_eq!((&summary["candidates"], given), (&json!(candidates), Some(scale)));
    }
    assert_eq!(told[0], [None; 2], "it was not asked");
    assert!(told[1].iter().all(Option::is_some) && told[1][1] > Some(0.0), "of six: {told:?}");
    assert!(told[2][0].is_some() && told[2][0] != told[3][0], "led far, and led hardly at all: {told:?}");
}

pub fn oracle(future: TrueFuture) -> tempfile::TempDir {
    fresh(|config| {
        config.method.latent = LatentSource::Truth { dim: 2, future };
        config.units.context = Some(Affine { mean: vec![1.0, -1.0], std: vec![2.0, 0.5] });
        config.defaults.sampler.kappa = 0.0;
    })
}

/// An oracle cannot act without the true context, says how it wants it, and acts on what it is told.
#[tokio::test(flavor = "multi_thread")]
async fn an_oracle_is_told_the_true_context() {
    let ways: [(TrueFuture, pb::TrueFuture, &str); 2] =
        [(TrueFuture::Held, pb::TrueFuture::Held, "held"), (TrueFuture::Known, pb::TrueFuture::Known, "known")];
    for (future, of_grpc, word) in ways {
        let server = serve(&oracle(future)).await;
        let model = server.get("/v1/models/fresh").await.json()["model"].clone();
        assert_eq!((&model["context"], &model["latent_dim"]), (&json!({"dim": 2, "future": word}), &json!(2)));
        let grpc = server.models().await.get(pb::GetModelRequest { model: String::new() }).await.unwrap().into_inner().model.unwrap();
        let context = grpc.context.unwrap();
        assert_eq!((context.dim, context.future()), (2, of_grpc));
        let ids = open(&server, pb::SamplerOptions::default(), json!({})).await.unwrap();
        type Wrong<'a> = (Option<&'a [&'a [f32]]>, &'a str, &'a str);
        let wrong: [Wrong; 5] = [
            (None, "observation.context", "this checkpoint is an oracle"),
            (Some(&[]), "observation.context", "has 0 rows"),
            (Some(&[&[0.0]]), "observation.context[0]", "has 1 values, the model takes 2"),
            (Some(&[&[0.0, 1e30]]), "observation.context[0][1]", "standard deviations"),
            (Some(&[&[0.0, 0.0][..]; 9]), "observation.context", "has 9 rows"),
        ];
        for (context, field, reason) in wrong {
            let (at, why) = act_on(&server, &ids, 1, context).await.unwrap_err();
            assert!(at == field && why.contains(reason), "{at}: {why}");
        }
        let first = act_on(&server, &ids, 1, Some(&[&[0.5, -0.5]])).await.unwrap();
        assert_eq!(first["latent_mean"], json!([-0.25, 1.0]), "in the units of the network: what it was told is its latent");
        let again = act_on(&server, &ids, 1, Some(&[&[0.5, -0.5]])).await.unwrap();
        assert_eq!((&again["replayed"], &again["actions"]), (&json!(true), &first["actions"]));
        let body = json!({"step": 1, "observation": {"state": STATE, "context": [[0.5, 0.5]]}});
        assert_eq!(server.post(&format!("/v1/sessions/{}/act", ids[1]), &body).await.reason(), "STEP_PAYLOAD_MISMATCH");
        let others = open(&server, pb::SamplerOptions::default(), json!({})).await.unwrap();
        let other = act_on(&server, &others, 1, Some(&[&[3.5, -0.5]])).await.unwrap();
        assert_ne!(other["actions"], first["actions"], "another context, other actions");
        if future == TrueFuture::Known {
            let ahead = open(&server, pb::SamplerOptions::default(), json!({})).await.unwrap();
            let turns = act_on(&server, &ahead, 1, Some(&[&[0.5, -0.5], &[3.5, 0.5]])).await.unwrap();
            assert_ne!(turns["actions"], first["actions"], "what comes is known too");
        }
    }
}

/// A matrix that says another number of values than it holds, or rows of none, is not taken for what it may have meant.
#[tokio::test(flavor = "multi_thread")]
async fn a_matrix_holds_what_it_says() {
    let server = serve(&oracle(TrueFuture::Known)).await;
    let id = server.open(json!({})).await;
    for (values, rows, columns) in
        [(vec![0.0; 3], 2, 2), (vec![0.0; 4], 1, 2), (vec![], u32::MAX, 0), (vec![0.0; 4], u32::MAX, u32::MAX), (vec![], 0, 2)]
    {
        let mut request = act(&id, 1, &STATE);
        request.observation.as_mut().unwrap().context = Some(pb::Matrix { values, rows, columns });
        let refused = server.agent().await.act(request).await.unwrap_err();
        assert_eq!(failure(&refused), (Code::InvalidArgument, "OBSERVATION_INVALID".into()), "{refused:?}");
        assert_eq!(trailer(&refused, "ada-field").as_deref(), Some("observation.context"));
        let said = if rows == 0 { "has 0 rows".to_owned() } else { format!("values in {rows} rows of {columns}") };
        assert!(refused.message().contains(&said), "{refused:?}");
    }
    let mut request = act(&id, 1, &STATE);
    request.observation.as_mut().unwrap().context = Some(pb::Matrix { values: vec![0.0, f32::NAN], rows: 1, columns: 2 });
    let refused = server.agent().await.act(request).await.unwrap_err();
    assert_eq!(trailer(&refused, "ada-field").as_deref(), Some("observation.context[0][1]"));
}

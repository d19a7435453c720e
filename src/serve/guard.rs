//! Whom a browser may speak for. Loopback is no wall: any page that a developer has open may post to 127.0.0.1, and a page whose name was bound anew
//! (DNS rebinding) may even read the answers. So until there is authentication, a server on loopback answers only to names of loopback, a request
//! that says which page it comes from (`Origin`) is refused unless the page is listed, and a REST body must say that it is JSON, which a page cannot
//! do without asking first.

use crate::serve::{config::ServerConfig, http::Problem};
use axum::http::{HeaderMap, HeaderValue, Method, Request, StatusCode, Uri, header};
use std::net::{IpAddr, SocketAddr};
use tower_http::cors::CorsLayer;

/// See the module.
#[derive(Clone, Debug)]
pub struct Guard {
    /// Names that the server answers to; None: any.
    hosts: Option<Vec<String>>,
    origins: Vec<HeaderValue>,
}

impl Guard {
    /// The guard of a server that is bound to this address. `server.hosts` and `server.origins` were checked with the other settings.
    pub fn new(config: &ServerConfig, bound: Option<SocketAddr>) -> Self {
        let is_loopback = bound.is_some_and(|address| address.ip().is_loopback());
        let hosts = match (config.hosts.is_empty(), is_loopback) {
            (false, _) => Some(config.hosts.iter().map(|host| host.to_ascii_lowercase()).collect()),
            (true, true) => Some(vec![host_of(&config.listen).to_ascii_lowercase()]),
            (true, false) => None,
        };
        let origins = config.origins.iter().filter_map(|origin| HeaderValue::from_str(origin).ok()).collect();
        Self { hosts, origins }
    }

    /// Why a request is refused, if it is.
    pub fn refuses<B>(&self, request: &Request<B>) -> Option<Problem> {
        if let Some(host) = host(request.uri(), request.headers()).filter(|host| !self.answers_to(host)) {
            let detail = format!("this server does not answer to the name {host:?}; server.hosts lists those it does");
            return Some(Problem::new(StatusCode::MISDIRECTED_REQUEST, "HOST_FORBIDDEN", &detail));
        }
        let origin = request.headers().get(header::ORIGIN).filter(|origin| !self.origins.contains(origin))?;
        let detail = format!("pages of {origin:?} are not listed in server.origins");
        Some(Problem::new(StatusCode::FORBIDDEN, "ORIGIN_FORBIDDEN", &detail))
    }

    /// What pages that are listed may do (CORS).
    pub fn cors(&self) -> CorsLayer {
        CorsLayer::new()
            .allow_origin(self.origins.clone())
            .allow_methods([Method::GET, Method::POST, Method::DELETE])
            .allow_headers([header::CONTENT_TYPE, header::HeaderName::from_static("x-request-id")])
            .expose_headers([header::RETRY_AFTER, header::HeaderName::from_static("x-request-id")])
    }

    fn answers_to(&self, host: &str) -> bool {
        let names_loopback =
            || host == "localhost" || host.ends_with(".localhost") || host.parse().is_ok_and(|ip: IpAddr| ip.is_loopback());
        self.hosts.as_ref().is_none_or(|hosts| hosts.iter().any(|known| known == host) || names_loopback())
    }
}

/// The name in the request, without port and brackets, lower case; None if it has none, as one that is not of a browser may.
fn host(uri: &Uri, headers: &HeaderMap) -> Option<String> {
    let text = uri.authority().map(|authority| authority.as_str()).or_else(|| headers.get(header::HOST)?.to_str().ok())?;
    Some(host_of(text).to_ascii_lowercase())
}

fn host_of(text: &str) -> &str {
    match text.strip_prefix('[') {
        Some(inside) => inside.split(']').next().unwrap_or(inside),
        None => text.rsplit_once(':').map_or(text, |(host, _)| host),
    }
}

/// Whether a REST body says that it is JSON; what has no body need not.
pub fn is_json(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|kind| kind.to_str().ok()).unwrap_or_default();
    let kind = kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    kind == "application/json" || (kind.starts_with("application/") && kind.ends_with("+json"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::response::IntoResponse;

    fn guard(hosts: &[&str], origins: &[&str], bound: &str) -> Guard {
        let list = |words: &[&str]| words.iter().map(ToString::to_string).collect();
        Guard::new(&ServerConfig { hosts: list(hosts), origins: list(origins), ..ServerConfig::default() }, bound.parse().ok())
    }

    fn refused(guard: &Guard, host: &str, origin: Option<&str>) -> Option<u16> {
        let mut request = Request::builder().uri("/v1/sessions").header("host", host);
        if let Some(origin) = origin {
            request = request.header("origin", origin);
        }
        guard.refuses(&request.body(()).unwrap()).map(|problem| problem.into_response().status().as_u16())
    }

    #[test]
    fn loopback_answers_to_its_own_names() {
        let open = guard(&[], &[], "127.0.0.1:7777");
        for host in ["127.0.0.1:7777", "localhost:1", "LOCALHOST", "[::1]:7777", "127.8.0.1", "ada.localhost:7"] {
            assert_eq!(refused(&open, host, None), None, "{host}");
        }
        for host in ["evil.example:7777", "localhost.evil.example", "10.0.0.1", ""] {
            assert_eq!(refused(&open, host, None), Some(421), "{host}");
        }
        assert_eq!(refused(&guard(&["Robot.local"], &[], "127.0.0.1:7777"), "robot.LOCAL:7777", None), None);
        assert_eq!(refused(&guard(&[], &[], "0.0.0.0:7777"), "evil.example", None), None, "elsewhere a name is only a name");
        assert_eq!(refused(&guard(&["a.example"], &[], "0.0.0.0:7777"), "evil.example", None), Some(421));
    }

    #[test]
    fn pages_are_refused_unless_listed() {
        let (closed, open) = (guard(&[], &[], "127.0.0.1:1"), guard(&[], &["https://a.example"], "127.0.0.1:1"));
        assert_eq!(refused(&closed, "localhost", Some("https://a.example")), Some(403));
        assert_eq!(refused(&closed, "localhost", Some("null")), Some(403));
        assert_eq!(refused(&open, "localhost", Some("https://a.example")), None);
        assert_eq!(refused(&open, "localhost", Some("https://b.example")), Some(403));
    }

    #[test]
    fn json_is_said() {
        let said = |kind: &str| is_json(&HeaderMap::from_iter([(header::CONTENT_TYPE, kind.parse().unwrap())]));
        for kind in ["application/json", "Application/JSON; charset=utf-8", "application/merge-patch+json"] {
            assert!(said(kind), "{kind}");
        }
        for kind in ["text/plain", "application/x-www-form-urlencoded", "text/json", "", "application/jsonp"] {
            assert!(!said(kind), "{kind}");
        }
        assert!(!is_json(&HeaderMap::new()));
    }
}

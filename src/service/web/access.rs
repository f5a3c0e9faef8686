//! Checks the site of requests. Any web page can send requests to a port of its user's machine, so `Host` and `Origin` must
//! be those of this server.

use std::net::IpAddr;
use std::sync::Arc;

use tonic::codegen::http::uri::Authority;
use tonic::codegen::http::{HeaderMap, header};

use super::super::listen::Socket;
use crate::config::PublicUrl;

/// Which sites may use the viewer.
#[derive(Debug)]
pub(in crate::service) struct Access {
    /// The name of this machine, if other machines can connect.
    host_name: Option<String>,
    /// The URL of a proxy in front of this server.
    public_url: Option<PublicUrl>,
}

/// How a request arrived.
#[derive(Debug, Clone, Default)]
pub(super) struct Arrival {
    /// `None` for a Unix socket.
    local_ip: Option<IpAddr>,
    /// The names of the server's certificate. `None` without encryption.
    certificate_names: Option<Arc<[String]>>,
}

impl Arrival {
    pub(super) fn of(socket: &Socket) -> Self {
        Self { local_ip: socket.local_ip(), certificate_names: socket.certificate_names() }
    }

    /// The scheme of the server's URL.
    const fn scheme(&self) -> &'static str {
        if self.certificate_names.is_some() { "https" } else { "http" }
    }
}

/// Why a request is rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Denied {
    Host,
    Origin,
}

impl Denied {
    /// What the server expects.
    pub(super) const fn expected(self) -> &'static str {
        match self {
            Self::Host => "a Host header that names this server by its address or by localhost",
            Self::Origin => "no Origin header, or that of this server",
        }
    }
}

impl Access {
    pub(in crate::service) const fn new(host_name: Option<String>, public_url: Option<PublicUrl>) -> Self {
        Self { host_name, public_url }
    }

    /// Checks `Host` and `Origin` of a request. Returns the origins of WebSockets that its page may open, for a content
    /// security policy.
    pub(super) fn check_site(&self, headers: &HeaderMap, arrival: &Arrival) -> Result<String, Denied> {
        let host = single_header(headers, header::HOST).ok_or(Denied::Host)?;
        let public_authority = self.public_url.as_ref().map(PublicUrl::authority);
        let is_public_host = public_authority.is_some_and(|public| host.eq_ignore_ascii_case(public));
        if !is_public_host && !self.is_own_host(host, arrival) {
            return Err(Denied::Host);
        }
        // A request to the public host has come through the proxy, whose scheme is that of the public URL.
        let own = (!is_public_host).then_some((arrival.scheme(), host));
        let public = self.public_url.as_ref().map(|url| (url.scheme(), url.authority()));
        if headers.contains_key(header::ORIGIN) {
            let origin = single_header(headers, header::ORIGIN).and_then(|origin| origin.split_once("://"));
            let is_expected = |(scheme, host): (&str, &str)| {
                origin.is_some_and(|origin| origin.0 == scheme && origin.1.eq_ignore_ascii_case(host))
            };
            if !own.into_iter().chain(public).any(is_expected) {
                return Err(Denied::Origin);
            }
        }
        // `ws` for `http`, and `wss` for `https`.
        let origin = |(scheme, host): (&str, &str)| format!("{}://{host}", scheme.replace("http", "ws"));
        Ok(own.into_iter().chain(public).map(origin).collect::<Vec<_>>().join(" "))
    }

    /// The path of a request below the path of the public URL. Proxies may send it with that path or without.
    pub(super) fn path_below_public_url<'a>(&self, path: &'a str) -> &'a str {
        let public_path = self.public_url.as_ref().map_or("", PublicUrl::path);
        match path.strip_prefix(public_path) {
            Some("") => "/",
            Some(rest) if rest.starts_with('/') => rest,
            _ => path,
        }
    }

    /// Whether a `Host` header names this server. The port is not compared, because a tunnel may have another one.
    fn is_own_host(&self, host: &str, arrival: &Arrival) -> bool {
        // A host name that contains a user (`user@host`) is rejected.
        let Some(authority) = host.parse::<Authority>().ok().filter(|_| !host.contains('@')) else { return false };
        let name = authority.host();
        let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
        match address.map(|address| address.to_canonical()) {
            Ok(address) => address.is_loopback() || Some(address) == arrival.local_ip,
            Err(_) => {
                let certificate_names = arrival.certificate_names.iter().flat_map(|names| names.iter());
                let mut own_names = certificate_names.map(String::as_str).chain(self.host_name.as_deref());
                name.eq_ignore_ascii_case("localhost") || own_names.any(|own| is_name_of(own, name))
            }
        }
    }
}

/// Whether a name of a certificate stands for a host. `*.` at its begin stands for one label (RFC 9525, 6.3).
fn is_name_of(certificate_name: &str, host: &str) -> bool {
    match certificate_name.strip_prefix("*.") {
        Some(parent) => host.split_once('.').is_some_and(|(_, host)| host.eq_ignore_ascii_case(parent)),
        None => host.eq_ignore_ascii_case(certificate_name),
    }
}

/// The text of a header that occurs once.
fn single_header(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    let mut values = headers.get_all(name).iter();
    let value = values.next()?;
    value.to_str().ok().filter(|_| values.next().is_none())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access() -> Access {
        Access::new(Some("renderer".into()), None)
    }

    fn plain() -> Arrival {
        Arrival { local_ip: Some([192, 168, 1, 7].into()), certificate_names: None }
    }

    fn encrypted() -> Arrival {
        let names = ["localhost", "server.lab.example", "*.gpu.example"].map(str::to_owned);
        Arrival { certificate_names: Some(names.into()), ..plain() }
    }

    fn headers(list: &[(header::HeaderName, &str)]) -> HeaderMap {
        list.iter().map(|(name, value)| (name.clone(), value.parse().expect("expected a header"))).collect()
    }

    fn check(list: &[(header::HeaderName, &str)]) -> Result<String, Denied> {
        access().check_site(&headers(list), &plain())
    }

    #[test]
    fn host_names_this_server() {
        let own = [
            "localhost",
            "LOCALHOST:1",
            "127.0.0.1:50051",
            "127.8.9.1",
            "[::1]:50051",
            "[::1]",
            "192.168.1.7:50051",
            "[::ffff:192.168.1.7]:1",
            "renderer:50051",
        ];
        for host in own {
            assert_eq!(check(&[(header::HOST, host)]), Ok(format!("ws://{host}")));
        }
        let foreign = [
            "evil.example",
            "evil.example:50051",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "192.168.1.8",
            "localhost@evil.example",
            "evil@localhost",
            "0.0.0.0",
            "",
            ":50051",
            "local host",
        ];
        for host in foreign {
            assert_eq!(check(&[(header::HOST, host)]), Err(Denied::Host), "{host}");
        }
        assert_eq!(check(&[]), Err(Denied::Host));
        let local = Access::new(None, None);
        let name = headers(&[(header::HOST, "renderer")]);
        assert_eq!(local.check_site(&name, &Arrival::default()), Err(Denied::Host));
    }

    #[test]
    fn origin_is_that_of_the_host() {
        let check = |host, origin| check(&[(header::HOST, host), (header::ORIGIN, origin)]);
        assert!(check("localhost:8000", "http://localhost:8000").is_ok());
        assert!(check("localhost:8000", "http://LOCALHOST:8000").is_ok());
        for (host, origin) in [
            ("localhost:8000", "http://localhost:8001"),
            ("localhost:8000", "http://localhost"),
            ("localhost:8000", "https://localhost:8000"),
            ("localhost:8000", "http://127.0.0.1:8000"),
            ("localhost:8000", "http://evil.example"),
            ("localhost:8000", "null"),
            ("localhost:8000", ""),
        ] {
            assert_eq!(check(host, origin), Err(Denied::Origin), "{origin}");
        }
    }

    /// The names of the certificate are own names, and origins begin with `https`.
    #[test]
    fn encrypted_site_has_the_names_of_its_certificate() {
        let check = |host: &str, origin: &str, arrival: &Arrival| {
            access().check_site(&headers(&[(header::HOST, host), (header::ORIGIN, origin)]), arrival)
        };
        for host in ["localhost:1", "server.lab.example:1", "SERVER.lab.example", "node1.gpu.example", "192.168.1.7"] {
            assert_eq!(check(host, &format!("https://{host}"), &encrypted()), Ok(format!("wss://{host}")));
            assert_eq!(check(host, &format!("http://{host}"), &encrypted()), Err(Denied::Origin), "{host}");
        }
        assert_eq!(check("server.lab.example", "http://server.lab.example", &plain()), Err(Denied::Host));
        for host in ["lab.example", "gpu.example", "a.b.gpu.example", "evil.example", "192.168.1.8"] {
            assert_eq!(check(host, &format!("https://{host}"), &encrypted()), Err(Denied::Host), "{host}");
        }
    }

    /// A proxy may keep the public `Host`, or send its own one.
    #[test]
    fn public_url_is_accepted_beside_the_own_addresses() {
        let public_url = Some("https://lab.example/render".parse().expect("expected a URL"));
        let access = Access::new(None, public_url);
        let check = |host: &str, origin: &str| {
            access.check_site(&headers(&[(header::HOST, host), (header::ORIGIN, origin)]), &plain())
        };
        for host in ["lab.example", "LAB.example"] {
            assert_eq!(check(host, "https://lab.example"), Ok("wss://lab.example".into()));
        }
        let own = "127.0.0.1:50051";
        assert_eq!(check(own, "https://lab.example"), Ok(format!("ws://{own} wss://lab.example")));
        assert!(check("127.0.0.1:50051", "http://127.0.0.1:50051").is_ok());
        for (host, origin, denied) in [
            ("lab.example:444", "https://lab.example", Denied::Host),
            ("evil.example", "https://lab.example", Denied::Host),
            ("lab.example", "https://evil.example", Denied::Origin),
            ("127.0.0.1:50051", "http://lab.example.evil", Denied::Origin),
            ("lab.example", "http://lab.example", Denied::Origin),
            ("lab.example", "null", Denied::Origin),
        ] {
            assert_eq!(check(host, origin), Err(denied), "{host} {origin}");
        }
        for (path, below) in [
            ("/render/", "/"),
            ("/render", "/"),
            ("/render/websocket", "/websocket"),
            ("/websocket", "/websocket"),
            ("/rendering", "/rendering"),
            ("/", "/"),
        ] {
            assert_eq!(access.path_below_public_url(path), below);
            assert_eq!(super::tests::access().path_below_public_url(path), path);
        }
    }

    #[test]
    fn repeated_headers_are_rejected() {
        let mut headers = headers(&[(header::HOST, "localhost")]);
        headers.append(header::HOST, "evil.example".parse().expect("expected a header"));
        assert_eq!(access().check_site(&headers, &plain()), Err(Denied::Host));
        headers.insert(header::HOST, "localhost".parse().expect("expected a header"));
        for _ in 0..2 {
            headers.append(header::ORIGIN, "http://localhost".parse().expect("expected a header"));
        }
        assert_eq!(access().check_site(&headers, &plain()), Err(Denied::Origin));
    }
}

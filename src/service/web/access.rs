//! Checks the site of requests. Any web page can send requests to a port of its user's machine, so `Host` and `Origin` must
//! be those of this server.

use std::net::IpAddr;

use tonic::codegen::http::uri::Authority;
use tonic::codegen::http::{HeaderMap, header};

/// Which sites may use the viewer.
#[derive(Debug)]
pub(in crate::service) struct Access {
    /// The name of this machine, if other machines can connect.
    host_name: Option<String>,
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
    pub(in crate::service) const fn new(host_name: Option<String>) -> Self {
        Self { host_name }
    }

    /// Checks `Host` and `Origin` of a request that arrived at `local_ip`, and returns the host with its port.
    pub(super) fn check_site<'a>(&self, headers: &'a HeaderMap, local_ip: Option<IpAddr>) -> Result<&'a str, Denied> {
        let host = single_header(headers, header::HOST).ok_or(Denied::Host)?;
        if !self.is_own_host(host, local_ip) {
            return Err(Denied::Host);
        }
        if headers.contains_key(header::ORIGIN) {
            let origin = single_header(headers, header::ORIGIN).and_then(|origin| origin.strip_prefix("http://"));
            if !origin.is_some_and(|origin| origin.eq_ignore_ascii_case(host)) {
                return Err(Denied::Origin);
            }
        }
        Ok(host)
    }

    /// Whether a `Host` header names this server. The port is not compared, because a tunnel may have another one.
    fn is_own_host(&self, host: &str, local_ip: Option<IpAddr>) -> bool {
        // A host name that contains a user (`user@host`) is rejected.
        let Some(authority) = host.parse::<Authority>().ok().filter(|_| !host.contains('@')) else { return false };
        let name = authority.host();
        let address = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
        match address.map(|address| address.to_canonical()) {
            Ok(address) => address.is_loopback() || Some(address) == local_ip,
            Err(_) => {
                let own_name = self.host_name.as_deref();
                name.eq_ignore_ascii_case("localhost") || own_name.is_some_and(|own| name.eq_ignore_ascii_case(own))
            }
        }
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
        Access::new(Some("renderer".into()))
    }

    fn headers(list: &[(header::HeaderName, &str)]) -> HeaderMap {
        list.iter().map(|(name, value)| (name.clone(), value.parse().expect("expected a header"))).collect()
    }

    fn check(list: &[(header::HeaderName, &str)]) -> Result<String, Denied> {
        let local_ip = Some([192, 168, 1, 7].into());
        access().check_site(&headers(list), local_ip).map(str::to_owned)
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
            assert_eq!(check(&[(header::HOST, host)]), Ok(host.into()));
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
        let local = Access::new(None);
        let name = headers(&[(header::HOST, "renderer")]);
        assert_eq!(local.check_site(&name, None), Err(Denied::Host));
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

    #[test]
    fn repeated_headers_are_rejected() {
        let mut headers = headers(&[(header::HOST, "localhost")]);
        headers.append(header::HOST, "evil.example".parse().expect("expected a header"));
        assert_eq!(access().check_site(&headers, None), Err(Denied::Host));
        headers.insert(header::HOST, "localhost".parse().expect("expected a header"));
        for _ in 0..2 {
            headers.append(header::ORIGIN, "http://localhost".parse().expect("expected a header"));
        }
        assert_eq!(access().check_site(&headers, None), Err(Denied::Origin));
    }
}

//! The address of a page: parsing, and the addresses at which this machine can be reached.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};

/// Default port of a page.
const PORT: u16 = 8080;

/// An address to serve at: `8080`, `:8080` and `localhost:8080` are this machine only,
/// `0.0.0.0:8080` is every address of it; the port may be left out.
pub fn parse(text: &str) -> Result<SocketAddr, String> {
    let wrong = || {
        format!(
            "`{text}` is no address to serve at; give a port as 8080, or an address of this machine as \
             127.0.0.1:8080 (this machine only) or 0.0.0.0:8080 (also others)"
        )
    };
    let (host, port) = match text.trim() {
        address if address.parse::<IpAddr>().is_ok() => (address, None),
        text => match text.rsplit_once(':') {
            Some((host, port)) => (host, Some(port)),
            None if text.bytes().all(|byte| byte.is_ascii_digit()) => ("", Some(text)),
            None => (text, None),
        },
    };
    let host = match host.trim_start_matches('[').trim_end_matches(']') {
        "" | "localhost" => IpAddr::from(Ipv4Addr::LOCALHOST),
        host => host.parse().map_err(|_| wrong())?,
    };
    let port = port.map_or(Ok(PORT), str::parse).map_err(|_| wrong())?;
    Ok(SocketAddr::new(host, port))
}

/// The addresses at which a page bound to `address` can be reached; those of this machine where it
/// is bound to all of them.
pub fn reachable(address: SocketAddr) -> Vec<SocketAddr> {
    if !address.ip().is_unspecified() {
        return vec![address];
    }
    let loopback = match address {
        SocketAddr::V4(_) => IpAddr::from(Ipv4Addr::LOCALHOST),
        SocketAddr::V6(_) => IpAddr::from(Ipv6Addr::LOCALHOST),
    };
    let own = own_addresses().into_iter().map(IpAddr::from);
    own.chain([loopback]).map(|ip| SocketAddr::new(ip, address.port())).collect()
}

/// The IPv4 addresses of this machine except loopback: from Linux's routing table, on other systems
/// the one of the default route.
fn own_addresses() -> Vec<Ipv4Addr> {
    if let Ok(table) = std::fs::read_to_string("/proc/net/fib_trie") {
        return local_in(&table);
    }
    // Connecting a datagram socket sends nothing; it only chooses the route.
    let by_route = || {
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
        socket.connect((Ipv4Addr::new(192, 0, 2, 1), 9)).ok()?;
        match socket.local_addr().ok()?.ip() {
            IpAddr::V4(ip) if !ip.is_loopback() => Some(ip),
            _ => None,
        }
    };
    by_route().into_iter().collect()
}

/// The host addresses in the text of `/proc/net/fib_trie`.
fn local_in(table: &str) -> Vec<Ipv4Addr> {
    let mut found = Vec::new();
    let mut leaf: Option<Ipv4Addr> = None;
    for line in table.lines() {
        if let Some((_, address)) = line.split_once("|-- ") {
            leaf = address.trim().parse().ok();
        } else if line.contains("/32 host LOCAL")
            && let Some(address) = leaf.filter(|address| !address.is_loopback())
            && !found.contains(&address)
        {
            found.push(address);
        }
    }
    found
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // in a test, what cannot be is a failure of the test
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_as_people_type_them() {
        for (text, expected) in [
            ("8080", "127.0.0.1:8080"),
            (":8081", "127.0.0.1:8081"),
            ("localhost:9000", "127.0.0.1:9000"),
            ("localhost", "127.0.0.1:8080"),
            ("0.0.0.0:8080", "0.0.0.0:8080"),
            ("192.168.1.5", "192.168.1.5:8080"),
            ("[::1]:80", "[::1]:80"),
            ("::1", "[::1]:8080"),
        ] {
            assert_eq!(parse(text).unwrap().to_string(), expected, "{text}");
        }
        for text in ["", "hello", "99999", "localhost:", "1.2.3:80", "80:80:80", "http://localhost:8080"] {
            let parsed = parse(text).map_err(|message| message.contains("no address to serve at"));
            assert_eq!(parsed, Err(true), "{text}");
        }
    }

    #[test]
    fn a_page_for_all_is_reached_at_the_addresses_of_this_machine() {
        let table = "Main:\n  +-- 0.0.0.0/0 3 0 5\n     |-- 0.0.0.0\n        /0 universe UNICAST\n     \
                     |-- 10.0.0.7\n        /32 host LOCAL\n     |-- 127.0.0.1\n        /32 host LOCAL\n\
                     Local:\n     |-- 10.0.0.7\n        /32 host LOCAL\n";
        assert_eq!(local_in(table), [Ipv4Addr::new(10, 0, 0, 7)]);
        let all = reachable("0.0.0.0:8080".parse().unwrap());
        assert!(all.contains(&"127.0.0.1:8080".parse().unwrap()));
        assert!(all.iter().all(|address| !address.ip().is_unspecified()), "{all:?}");
        let one = "192.168.1.5:80".parse().unwrap();
        assert_eq!(reachable(one), [one]);
    }
}

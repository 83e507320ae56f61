//! HTTPS between robots and site, with certificates that are made here.

use crate::robots::Robot;
use crate::served::{TOKEN, bearer};
use odograph_site::{RobotTokens, Site, SiteClient, SiteIdentity, SiteLink, SiteServer, TrustedAuthorities};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// An authority, with its certificate in a file.
struct Authority {
    issuer: CertifiedIssuer<'static, KeyPair>,
    file: PathBuf,
}

impl Authority {
    fn new(folder: &Path, name: &str) -> Self {
        let mut parameters = CertificateParams::new(Vec::new()).unwrap();
        parameters.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        parameters.distinguished_name.push(rcgen::DnType::CommonName, name);
        let issuer = CertifiedIssuer::self_signed(parameters, KeyPair::generate().unwrap()).unwrap();
        let file = folder.join(format!("{name}.pem"));
        std::fs::write(&file, issuer.pem()).unwrap();
        Self { issuer, file }
    }

    /// Files with a certificate for a host and its key.
    fn certify(
        &self,
        folder: &Path,
        host: &str,
        change: impl FnOnce(&mut CertificateParams),
    ) -> [PathBuf; 2] {
        let key = KeyPair::generate().unwrap();
        let mut parameters = CertificateParams::new(vec![host.to_owned()]).unwrap();
        change(&mut parameters);
        let certificate = parameters.signed_by(&key, &self.issuer).unwrap();
        let files = ["cert", "key"].map(|what| folder.join(format!("{host}-{what}.pem")));
        std::fs::write(&files[0], certificate.pem()).unwrap();
        std::fs::write(&files[1], key.serialize_pem()).unwrap();
        files
    }

    fn trusted(&self) -> TrustedAuthorities {
        TrustedAuthorities::from_file_or_system(Some(&self.file)).unwrap()
    }
}

fn serve(folder: &Path, [certificate, key]: &[PathBuf; 2]) -> (Arc<Site>, SiteServer) {
    let site = Arc::new(Site::open(folder).unwrap());
    let identity = SiteIdentity::from_files(certificate, key).unwrap();
    let (address, token) = ("127.0.0.1:0".parse().unwrap(), Some(TOKEN.to_owned()));
    let server = SiteServer::start_encrypted(address, Arc::clone(&site), token, identity).unwrap();
    (site, server)
}

#[test]
fn a_robot_sends_its_map_over_https() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let authority = Authority::new(folder.path(), "authority");
    let (site, server) = serve(&place, &authority.certify(folder.path(), "127.0.0.1", |_| {}));
    let robot = Robot { lane: ((0.0, 0.0), 0.0, 60), ..Robot::first() };
    let map = robot.drive(folder.path());
    let file = folder.path().join("token");
    std::fs::write(&file, RobotTokens::in_folder(&place).add(robot.name).unwrap()).unwrap();
    let address = server.url().split('?').next().unwrap().parse::<odograph_site::SiteAddress>().unwrap();
    let client = SiteClient::new(address.with_token_of(&file).unwrap()).trusting(authority.trusted());
    let link = SiteLink::start(&map, robot.name, client, Box::new(|_| {})).unwrap();
    let report = link.finish(Duration::from_secs(60), &|| true);
    assert!(report.complete && report.acknowledged > 3, "{report:?}");
    site.wait_until_settled();
    let page = site.page();
    assert!(page["sessions"][0]["ended"] == true || page["sessions"][0]["condition"] == "ended", "{page}");
}

#[test]
fn only_the_site_of_a_trusted_authority_gets_the_token() {
    let folder = tempfile::tempdir().unwrap();
    let [authority, other] = ["authority", "other"].map(|name| Authority::new(folder.path(), name));
    let good = authority.certify(folder.path(), "127.0.0.1", |_| {});
    let asked = |files: &[PathBuf; 2], trusted: &Authority| {
        let place = tempfile::tempdir().unwrap();
        let (_site, server) = serve(place.path(), files);
        let client = SiteClient::new(server.url().parse().unwrap()).trusting(trusted.trusted());
        let answer = client.state().map(drop).map_err(|error| error.to_string());
        // What the site has read of a client that does not trust it is no request.
        assert!(answer.is_ok() || server.new_refusals().is_empty());
        answer
    };
    assert_eq!(asked(&good, &authority), Ok(()));
    let untrusted = asked(&good, &other).unwrap_err();
    assert!(untrusted.contains("not trusted") && untrusted.contains("--site-certificate"), "{untrusted}");
    let elsewhere = authority.certify(folder.path(), "127.0.0.2", |_| {});
    let expired = authority.certify(folder.path(), "127.0.0.1", |parameters| {
        parameters.not_before = rcgen::date_time_ymd(2020, 1, 1);
        parameters.not_after = rcgen::date_time_ymd(2020, 2, 1);
    });
    for files in [elsewhere, expired] {
        let refused = asked(&files, &authority).unwrap_err();
        assert!(refused.contains("not trusted") && !refused.contains(TOKEN), "{refused}");
    }
}

#[test]
fn tls_and_plain_http_refuse_each_other_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path(), "authority");
    let place = folder.path().join("site");
    let (site, server) = serve(&place, &authority.certify(folder.path(), "127.0.0.1", |_| {}));
    assert!(server.url().starts_with("https://"));
    let plain = server.url().replace("https://", "http://");
    let refused = SiteClient::new(plain.parse().unwrap()).state().unwrap_err().to_string();
    assert!(refused.contains("perhaps its address begins with https://"), "{refused}");
    // Neither noise nor a half handshake ends the server.
    for bytes in [&[0xff; 4000][..], b"\x16\x03\x01\x02\x00\x01", b""] {
        let mut stream = TcpStream::connect(server.address()).unwrap();
        let _ = stream.write_all(bytes);
        let _ = stream.shutdown(std::net::Shutdown::Write);
        let _ = stream.read_to_end(&mut Vec::new());
    }
    let client = SiteClient::new(server.url().parse().unwrap()).trusting(authority.trusted());
    client.state().unwrap();
    drop(server);
    let server = SiteServer::start("127.0.0.1:0".parse().unwrap(), site, None).unwrap();
    let encrypted = server.url().replace("http://", "https://");
    let client = SiteClient::new(encrypted.parse().unwrap()).trusting(authority.trusted());
    let refused = client.state().unwrap_err().to_string();
    assert!(refused.contains("perhaps its address begins with http://"), "{refused}");
}

#[test]
fn the_cookie_of_an_encrypted_page_stays_encrypted() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path(), "authority");
    let place = folder.path().join("site");
    let (_site, server) = serve(&place, &authority.certify(folder.path(), "localhost", |_| {}));
    let mut roots = rustls::RootCertStore::empty();
    roots.add(authority.issuer.der().clone()).unwrap();
    let config =
        rustls::ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
    let name = "localhost".try_into().unwrap();
    let connection = rustls::ClientConnection::new(Arc::new(config), name).unwrap();
    let mut stream = rustls::StreamOwned::new(connection, TcpStream::connect(server.address()).unwrap());
    let ask = |stream: &mut dyn Write, target: &str, header: &str| {
        write!(stream, "GET {target} HTTP/1.1\r\nHost: localhost\r\n{header}\r\n").unwrap();
    };
    // Two requests over one connection.
    ask(&mut stream, "/state", &bearer(TOKEN));
    let mut answer = vec![0; 15];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(answer, b"HTTP/1.1 200 OK");
    ask(&mut stream, &format!("/?token={TOKEN}"), "Connection: close\r\n");
    let mut rest = String::new();
    // Ends in order: a connection that is cut off is an error.
    stream.read_to_string(&mut rest).unwrap();
    assert!(rest.contains("HTTP/1.1 303 ") && rest.contains("SameSite=Strict; Secure\r\n"), "{rest}");
}

#[test]
fn files_that_are_no_certificate_and_key_are_refused_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let authority = Authority::new(folder.path(), "authority");
    let [certificate, key] = authority.certify(folder.path(), "a.example", |_| {});
    let [_, other_key] = authority.certify(folder.path(), "b.example", |_| {});
    let text = folder.path().join("text.pem");
    std::fs::write(&text, "no certificate").unwrap();
    let absent = folder.path().join("absent.pem");
    for (certificate, key, what) in [
        (&certificate, &other_key, "are not a certificate and its key"),
        (&key, &key, "has no certificate"),
        (&text, &key, "has no certificate"),
        (&certificate, &certificate, "has no private key"),
        (&certificate, &absent, "cannot be read"),
        (&absent, &key, "cannot be read"),
    ] {
        let refused = SiteIdentity::from_files(certificate, key).unwrap_err().to_string();
        assert!(refused.contains(what) && refused.contains(".pem"), "{refused}");
    }
    for file in [&text, &absent, &key] {
        assert!(TrustedAuthorities::from_file_or_system(Some(file)).is_err(), "{}", file.display());
    }
}

//! How a site is reached: its address, the token for it, and whose certificates are accepted.

use crate::console;
use odograph::error::{Error, Result};
use odograph_site::{SiteAddress, SiteClient, TrustedAuthorities};
use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// An address as it was typed. What is wrong with it is said without repeating it: it may contain a
/// token.
#[derive(Debug, Clone)]
pub struct GivenSite(std::result::Result<SiteAddress, String>);

impl FromStr for GivenSite {
    type Err = Infallible;

    fn from_str(text: &str) -> std::result::Result<Self, Infallible> {
        Ok(Self(text.parse::<SiteAddress>().map_err(|error| error.to_string())))
    }
}

impl GivenSite {
    fn address(&self) -> Result<&SiteAddress> {
        self.0.as_ref().map_err(|what| Error::usage(format!("--site: {what}")))
    }
}

/// What a site requires of those that reach it.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct SiteCredentials {
    /// File with the token for the site, alone on its first line.
    ///
    /// A token in a file is not in the list of processes, nor in the log of commands.
    #[arg(help_heading = "Site", long, value_name = "FILE")]
    site_token: Option<PathBuf>,
    /// Certificate of the authority that has signed that of an https:// site, as PEM.
    ///
    /// Without it the authorities that this system trusts.
    #[arg(help_heading = "Site", long, value_name = "FILE")]
    site_certificate: Option<PathBuf>,
}

impl SiteCredentials {
    /// Whether there are any.
    pub fn are_any(&self) -> bool {
        self.site_token.is_some() || self.site_certificate.is_some()
    }

    /// A client of the site.
    pub fn client(&self, site: &GivenSite) -> Result<SiteClient> {
        let site = site.address()?.clone();
        let site = match &self.site_token {
            Some(file) => site.with_token_of(file)?,
            None => site,
        };
        match (site.is_encrypted(), &self.site_certificate) {
            (true, file) => {
                let authorities = TrustedAuthorities::from_file_or_system(file.as_deref())?;
                Ok(SiteClient::new(site).trusting(authorities))
            }
            (false, None) => Ok(SiteClient::new(site)),
            (false, Some(_)) => Err(Error::usage(format!(
                "--site-certificate is of an encrypted site, and {site} is not encrypted; its address begins with \
                 https://"
            ))),
        }
    }

    /// The options that reach the site again, without a token.
    pub fn shown(&self, site: &GivenSite) -> Result<String> {
        let site = site.address()?;
        let quoted = |text: &Path| console::quoted(text);
        let token = match &self.site_token {
            Some(file) => format!(" --site-token {}", quoted(file)),
            // A file that has the token of the address.
            None if site.has_token() => " --site-token FILE".to_owned(),
            None => String::new(),
        };
        let certificate = self
            .site_certificate
            .as_ref()
            .map_or(String::new(), |file| format!(" --site-certificate {}", quoted(file)));
        Ok(format!("--site {}{token}{certificate}", quoted(Path::new(&site.to_string()))))
    }
}

/// A site that a command asks.
#[derive(Debug, clap::Args)]
pub struct ReachedSite {
    /// Address of the site, as it printed it.
    #[arg(long, value_name = "URL")]
    site: GivenSite,
    #[command(flatten)]
    credentials: SiteCredentials,
}

impl ReachedSite {
    /// A client of the site.
    pub fn client(&self) -> Result<SiteClient> {
        self.credentials.client(&self.site)
    }
}

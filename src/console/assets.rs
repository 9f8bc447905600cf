//! The page's parts, inside the binary: no other host is ever asked for anything.

use std::io::{Read, Write};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

/// One part, ready to be sent.
#[derive(Debug)]
pub struct Asset {
    pub path: &'static str,
    pub media_type: &'static str,
    pub gzip: Vec<u8>,
    /// Changes with the content.
    pub etag: String,
}

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const JS: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";

macro_rules! page {
    ($($path:literal $file:literal $media_type:expr),+ $(,)?) => {
        [$(($path, $media_type, include_bytes!(concat!("page/", $file)).as_slice())),+]
    };
}

/// Packed before it was committed; how it was made stands in `page/vendor/README.md`.
const THREE: (&str, &[u8]) = ("/vendor/three.js", include_bytes!("page/vendor/three.js.gz"));

/// All parts.
#[derive(Debug)]
pub struct Assets(Vec<Asset>);

impl Assets {
    /// Packs them; some milliseconds, once.
    pub fn load() -> std::io::Result<Self> {
        let plain = page![
            "/" "index.html" HTML,
            "/style.css" "style.css" CSS,
            "/icon.svg" "icon.svg" SVG,
            "/main.js" "main.js" JS,
            "/wire.js" "wire.js" JS,
            "/link.js" "link.js" JS,
            "/state.js" "state.js" JS,
            "/video.js" "video.js" JS,
            "/map.js" "map.js" JS,
            "/graph.js" "graph.js" JS,
            "/obstacles.js" "obstacles.js" JS,
            "/tags.js" "tags.js" JS,
            "/charts.js" "charts.js" JS,
            "/controls.js" "controls.js" JS,
            "/camera.js" "camera.js" JS,
            "/log.js" "log.js" JS,
            "/pair.js" "pair.js" JS,
            "/calibrate.js" "calibrate.js" JS,
            "/board.js" "board.js" JS,
            "/calibrate.css" "calibrate.css" CSS,
        ];
        let mut assets = Vec::with_capacity(plain.len() + 1);
        for (path, media_type, bytes) in plain {
            let mut gzip = GzEncoder::new(Vec::new(), Compression::best());
            gzip.write_all(bytes)?;
            assets.push(asset(path, media_type, gzip.finish()?));
        }
        assets.push(asset(THREE.0, JS, THREE.1.to_vec()));
        Ok(Self(assets))
    }

    pub fn find(&self, path: &str) -> Option<&Asset> {
        self.0.iter().find(|asset| asset.path == path)
    }

    /// What a page weighs on its way, bytes.
    pub fn weight(&self) -> usize {
        self.0.iter().map(|asset| asset.gzip.len()).sum()
    }
}

impl Asset {
    /// As it is without compression.
    pub fn plain(&self) -> std::io::Result<Vec<u8>> {
        let mut plain = Vec::new();
        GzDecoder::new(self.gzip.as_slice()).read_to_end(&mut plain)?;
        Ok(plain)
    }
}

fn asset(path: &'static str, media_type: &'static str, gzip: Vec<u8>) -> Asset {
    // FNV-1a: it tells versions of a file apart and need withstand nobody.
    let hash = gzip.iter().fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3));
    Asset { path, media_type, gzip, etag: format!("\"{hash:016x}\"") }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the page may weigh on its way, bytes: a second on a poor radio link.
    const MOST: usize = 400 * 1024;

    #[test]
    fn the_page_is_light_and_asks_no_other_host() {
        let assets = Assets::load().expect("assets");
        assert!(assets.weight() < MOST, "{} bytes", assets.weight());
        for asset in &assets.0 {
            let text = String::from_utf8(asset.plain().expect("gzip")).expect("UTF-8");
            assert!(!text.is_empty(), "{}", asset.path);
            // An SVG's name space is a name and not fetched; the library names the ones of XHTML.
            let foreign = text.split("://").skip(1).filter(|rest| !rest.starts_with("www.w3.org/"));
            let foreign: Vec<_> = foreign.map(|rest| rest.chars().take(30).collect::<String>()).collect();
            assert!(foreign.iter().all(|rest| rest.starts_with("${location.host}")), "{}: {foreign:?}", asset.path);
        }
    }

    #[test]
    fn the_bundle_keeps_its_licence() {
        let assets = Assets::load().expect("assets");
        let three = assets.find(THREE.0).and_then(|a| a.plain().ok()).expect("three");
        let text = String::from_utf8_lossy(&three[..300]).into_owned();
        assert!(text.contains("Three.js Authors") && text.contains("SPDX-License-Identifier: MIT"), "{text}");
    }
}

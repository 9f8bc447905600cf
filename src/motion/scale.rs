//! The length of a map unit in metres, from everything that tells it.

use crate::map::scale::{MapScale, ScaleSource, ScaleSources};

/// One source's word on how long a map unit is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScaleMeasurement {
    pub source: ScaleSource,
    /// ln(metres per map unit).
    pub log_metres_per_unit: f64,
    /// Its standard deviation (0.01: 1 %).
    pub sigma: f64,
}

/// A map becomes metric once its scale is known to this, and stays so.
pub const METRIC_SIGMA: f64 = 0.05;
/// A metric map is scaled again where the fused word differs by more than this share of its standard deviation, and by more than this at all.
const REFINE_SHARE: f64 = 0.3;
const REFINE_LEAST: f64 = 0.001;
/// No number of words makes a source better than this, whatever is said of the error that all its words share: a floor is no plane, and what
/// poses have wrong alike does not average out (in eight drives of the simulator by the true height lengths were 1.5 % off, RMS). What tells by wheels or tags has it in its sigma already.
const COMMON_SIGMA: [f64; 4] = [0.0, 0.012, 0.0, 0.0];
/// What is known anew takes the place of what was known before once its standard deviation is below this share of that: the word of a source that told a
/// stored scale, too, and the ratio of a part behind a turn.
pub const SURER_SHARE: f64 = 0.7;
/// A word this many standard deviations from what its own source has said so far, several times, replaces that; fewer times it is left out.
const CONTRADICTS: f64 = 5.0;
const INSISTS: u32 = 3;

/// What one source has said so far.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Word {
    log: f64,
    variance: f64,
    /// What all words of this source share.
    common_variance: f64,
    /// Words in a row that contradict.
    contradicted: u32,
}

/// What all words of a source share, given what is said of it.
fn common_variance(source: ScaleSource, common_sigma: f64) -> f64 {
    common_sigma.powi(2).max(COMMON_SIGMA[source as usize].powi(2))
}

/// All that is said of one map's scale.
///
/// Words of heights come one by one and count as independent but for what they have in common, which is what bounds their sigma: adjustments hold the floor that
/// earlier words told; what wheels and tags say is one word each that is
/// renewed. Sources are independent of each other and are brought together by their variances. An error common to both wheels is
/// in the wheels' sigma, so beside a tag the tag decides, and the wheels hold what it said.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ScaleFusion {
    words: [Option<Word>; 4],
    /// Who told the scale that the map was stored with, in all runs before.
    stored: ScaleSources,
    metric: bool,
}

impl ScaleFusion {
    /// What one source has said: ln(metres per map unit).
    pub fn word(&self, source: ScaleSource) -> Option<f64> {
        self.words[source as usize].map(|word| word.log)
    }

    /// Of a map that was metric when it was stored.
    pub fn restored(sigma: f64, sources: ScaleSources) -> Self {
        let mut fusion = Self { stored: sources, metric: true, ..Self::default() };
        fusion.add(&ScaleMeasurement { source: ScaleSource::StoredMap, log_metres_per_unit: 0.0, sigma });
        fusion
    }

    /// Of a map that was stored with this.
    pub fn of_stored(scale: MapScale) -> Self {
        match scale {
            MapScale::Unknown => Self::default(),
            MapScale::Metric { sigma, sources } => Self::restored(sigma, sources),
        }
    }

    /// Takes a word on the present map as it is now. A second one of the wheels' or of tags replaces the one before, those of heights add to it. `false`, and nothing
    /// taken: it is not finite, or contradicts its own source.
    pub fn add(&mut self, measurement: &ScaleMeasurement) -> bool {
        self.add_sharing(measurement, 0.0)
    }

    /// The same for a word with an error of this standard deviation that all words of its source share, beside its own: a height's, by whoever measured it.
    pub fn add_sharing(&mut self, measurement: &ScaleMeasurement, common_sigma: f64) -> bool {
        let ScaleMeasurement { source, log_metres_per_unit: log, sigma } = *measurement;
        if !log.is_finite() || !sigma.is_finite() || sigma <= 0.0 || !common_sigma.is_finite() {
            return false;
        }
        let common_variance = common_variance(source, common_sigma);
        let new = Word { log, variance: sigma * sigma, common_variance, contradicted: 0 };
        let word = &mut self.words[source as usize];
        let Some(before) = word.as_mut().filter(|_| source == ScaleSource::Height) else {
            *word = Some(new);
            return true;
        };
        let common = COMMON_SIGMA[source as usize].powi(2);
        let limit = CONTRADICTS * CONTRADICTS * (before.variance + new.variance + common);
        if (new.log - before.log).powi(2) > limit {
            before.contradicted += 1;
            let insists = before.contradicted >= INSISTS;
            if insists {
                *before = new;
            }
            return insists;
        }
        let gain = before.variance / (before.variance + new.variance);
        before.log += gain * (new.log - before.log);
        before.variance *= 1.0 - gain;
        before.contradicted = 0;
        true
    }

    /// What all say together: ln(metres per map unit), and its standard deviation; and who.
    pub fn fused(&self) -> Option<(f64, f64, ScaleSources)> {
        let (mut information, mut sum, mut sources) = (0.0, 0.0, ScaleSources::default());
        let surest = ScaleSource::ALL.into_iter().filter(|source| self.is_of_stored(*source)).min_by(|a, b| {
            let variance = |source: &ScaleSource| match (self.variance(*source), source) {
                (Some(variance), ScaleSource::StoredMap) => SURER_SHARE * SURER_SHARE * variance,
                (variance, _) => variance.unwrap_or(f64::INFINITY),
            };
            variance(a).total_cmp(&variance(b))
        });
        let is_heard = |source: &ScaleSource| !self.is_of_stored(*source) || Some(*source) == surest;
        for source in ScaleSource::ALL.into_iter().filter(is_heard) {
            let (Some(word), Some(variance)) = (self.words[source as usize], self.variance(source)) else { continue };
            let weight = 1.0 / variance;
            information += weight;
            sum += weight * word.log;
            sources = sources.with(source);
        }
        let sources = sources.and(self.stored);
        (information > 0.0).then(|| (sum / information, information.recip().sqrt(), sources))
    }

    /// The stored word, or of a source that told it, too: what is wrong with a wheel's radius or a tag's printed size is in both, so they are not
    /// independent, and of all of these one is heard. Otherwise each run would make the same error smaller.
    fn is_of_stored(&self, source: ScaleSource) -> bool {
        source == ScaleSource::StoredMap || self.stored.contains(source)
    }

    fn variance(&self, source: ScaleSource) -> Option<f64> {
        self.words[source as usize].map(|word| word.variance + word.common_variance)
    }

    /// By what factor the map's lengths are to grow now, if they are: it becomes metric, or what is known has changed enough. To be followed by
    /// [`rescale`](Self::rescale).
    pub fn due(&self) -> Option<f64> {
        let (log, sigma, _) = self.fused()?;
        let due = match self.metric {
            false => sigma <= METRIC_SIGMA,
            true => log.abs() > (REFINE_SHARE * sigma).max(REFINE_LEAST),
        };
        due.then(|| log.exp())
    }

    /// Where the robot is, lengths are known anew by this word, whose source's words share an error of `common_sigma`: what was said of another part of the map
    /// does not make them surer.
    pub fn heard_behind_turn(&mut self, word: &ScaleMeasurement, common_sigma: f64) {
        let variance = word.sigma.powi(2) + common_variance(word.source, common_sigma);
        let known = self.fused().map_or(variance, |(_, sigma, _)| sigma * sigma);
        let wider = (variance / known).max(1.0);
        for word in self.words.iter_mut().flatten() {
            word.variance = wider * (word.variance + word.common_variance) - word.common_variance;
        }
    }

    /// What was said of another unit is said of the present one: ln of how many of these it is long, and the standard deviation of that; `None`: nobody
    /// knows, and nothing is left of it.
    pub fn carry(&mut self, ratio: Option<(f64, f64)>) {
        for word in &mut self.words {
            *word = word.zip(ratio).map(|(word, (log_ratio, sigma))| Word {
                log: word.log - log_ratio,
                variance: word.variance + sigma * sigma,
                ..word
            });
        }
    }

    /// The map's lengths are `factor` times as long from now on; they are metres.
    pub fn rescale(&mut self, factor: f64) {
        self.words.iter_mut().flatten().for_each(|word| word.log -= factor.ln());
        self.metric = true;
    }

    /// A metric map, known to this, has become a part of this one: `log_metres_per_unit` by the join.
    pub fn inherit(&mut self, other: &Self, log_metres_per_unit: f64, join_sigma: f64) {
        self.stored = self.stored.and(other.stored);
        for (mine, others) in self.words.iter_mut().zip(other.words).filter(|(mine, _)| mine.is_none()) {
            *mine = others.map(|word| Word {
                log: word.log + log_metres_per_unit,
                variance: word.variance + join_sigma * join_sigma,
                common_variance: word.common_variance,
                contradicted: 0,
            });
        }
    }

    pub fn is_metric(&self) -> bool {
        self.metric
    }

    /// As it is published.
    pub fn scale(&self) -> MapScale {
        match self.fused().filter(|_| self.metric) {
            Some((_, sigma, sources)) => MapScale::Metric { sigma, sources },
            None => MapScale::Unknown,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn word(source: ScaleSource, log: f64, sigma: f64) -> ScaleMeasurement {
        ScaleMeasurement { source, log_metres_per_unit: log, sigma }
    }

    #[test]
    fn a_map_becomes_metric_once_and_is_refined_where_that_matters() {
        let mut fusion = ScaleFusion::default();
        assert!(fusion.due().is_none() && fusion.scale() == MapScale::Unknown);
        assert!(fusion.add(&word(ScaleSource::Wheels, 0.7, 0.08)));
        assert!(fusion.due().is_none(), "known to 8 % only");
        fusion.add(&word(ScaleSource::Wheels, 0.72, 0.012));
        let factor = fusion.due().expect("known well");
        assert!((factor - 0.72_f64.exp()).abs() < 1e-12);
        fusion.rescale(factor);
        assert!(fusion.due().is_none() && fusion.is_metric());
        fusion.add(&word(ScaleSource::Wheels, 0.002, 0.012));
        assert!(fusion.due().is_none(), "well within what is known");
        fusion.add(&word(ScaleSource::Wheels, 0.008, 0.011));
        assert!((fusion.due().expect("a refinement").ln() - 0.008).abs() < 1e-12);
        let MapScale::Metric { sigma, sources } = fusion.scale() else { panic!("it is metric") };
        assert!((sigma - 0.011).abs() < 1e-12 && sources == ScaleSources::default().with(ScaleSource::Wheels));
    }

    #[test]
    fn behind_a_turn_a_map_is_no_surer_than_what_was_heard_there() {
        let mut fusion = ScaleFusion::default();
        (0..20).for_each(|_| assert!(fusion.add_sharing(&word(ScaleSource::Height, 0.0, 0.01), 0.006)));
        fusion.rescale(1.0);
        let sigma = |fusion: &ScaleFusion| fusion.fused().expect("a word").1;
        let before = sigma(&fusion);
        fusion.heard_behind_turn(&word(ScaleSource::Height, 0.0, 0.03), 0.006);
        assert!(before < 0.013 && (sigma(&fusion) - 0.03_f64.hypot(0.012)).abs() < 1e-9, "{before} {}", sigma(&fusion));
        fusion.heard_behind_turn(&word(ScaleSource::Height, 0.0, 0.01), 0.006);
        assert!(sigma(&fusion) > 0.03, "what was less sure before stays so");
        fusion.add(&word(ScaleSource::Tag, 0.0, 0.01));
        fusion.heard_behind_turn(&word(ScaleSource::Tag, 0.0, 0.04), 0.0);
        assert!((sigma(&fusion) - 0.04).abs() < 1e-9, "whatever several have said elsewhere");
        fusion.heard_behind_turn(&word(ScaleSource::Height, 0.0, 0.01), 0.05);
        assert!((sigma(&fusion) - 0.01_f64.hypot(0.05)).abs() < 1e-9, "by a height that is known to 5 %");
    }

    #[test]
    fn what_was_said_of_another_unit_is_carried_over_with_the_doubt_of_the_ratio_or_forgotten() {
        let mut fusion = ScaleFusion::default();
        fusion.add(&word(ScaleSource::Tag, 0.3, 0.03));
        // A unit there is two of the present ones long.
        fusion.carry(Some((2.0_f64.ln(), 0.04)));
        let (log, sigma, _) = fusion.fused().expect("told");
        assert!((log - (0.3 - 2.0_f64.ln())).abs() < 1e-12 && (sigma - 0.05).abs() < 1e-12, "{log} {sigma}");
        fusion.carry(None);
        assert!(fusion.fused().is_none());
    }

    #[test]
    fn beside_a_tag_the_tag_decides_and_its_last_word_is_what_counts() {
        let mut fusion = ScaleFusion::default();
        fusion.add(&word(ScaleSource::Wheels, 0.02, 0.01));
        fusion.add(&word(ScaleSource::Tag, 0.3, 0.02));
        fusion.add(&word(ScaleSource::Tag, 0.0, 0.002));
        let (log, sigma, sources) = fusion.fused().expect("two sources");
        assert!(log < 0.001, "{log}");
        assert!((0.0019..0.0021).contains(&sigma), "{sigma}");
        assert!(sources.contains(ScaleSource::Tag) && sources.contains(ScaleSource::Wheels));
        assert!(!sources.contains(ScaleSource::Height));
    }

    #[test]
    fn a_stored_scale_is_heard_and_what_told_it_is_not_heard_twice() {
        let wheels = ScaleSources::default().with(ScaleSource::Wheels);
        let mut fusion = ScaleFusion::restored(0.01, wheels);
        assert!(fusion.is_metric() && fusion.due().is_none());
        fusion.add(&word(ScaleSource::Wheels, 0.05, 0.01));
        assert_eq!(fusion.scale(), MapScale::Metric { sigma: 0.01, sources: wheels.with(ScaleSource::StoredMap) });
        fusion.add(&word(ScaleSource::Tag, 0.01, 0.002));
        let (log, sigma, sources) = fusion.fused().expect("told");
        assert!((0.009..0.01).contains(&log) && sigma < 0.002 && sources.contains(ScaleSource::Tag));
        let mut by_tag = ScaleFusion::restored(0.01, ScaleSources::default().with(ScaleSource::Tag));
        by_tag.add(&word(ScaleSource::Wheels, 0.0, 0.01));
        assert!(by_tag.fused().expect("told").1 < 0.0071, "independent of each other");
    }

    #[test]
    fn saving_and_loading_makes_no_scale_surer() {
        for source in [ScaleSource::Wheels, ScaleSource::Tag, ScaleSource::Height] {
            let mut fusion = ScaleFusion::default();
            fusion.add(&word(source, 0.0, 0.03));
            fusion.rescale(1.0);
            let MapScale::Metric { sigma: first, .. } = fusion.scale() else { panic!("it is metric") };
            for round in 0..3 {
                let MapScale::Metric { sigma, sources } = fusion.scale() else { panic!("it is metric") };
                fusion = ScaleFusion::restored(sigma, sources);
                fusion.add(&word(source, 0.004, 0.0285));
                let MapScale::Metric { sigma, sources } = fusion.scale() else { panic!("it is metric") };
                assert!((sigma - first).abs() < 1e-12, "{source:?}, round {round}: {sigma}");
                assert!(sources.contains(source) && sources.contains(ScaleSource::StoredMap));
            }
            // A much better word of the same source is not lost either.
            fusion.add(&word(source, 0.004, 0.002));
            let (log, sigma, _) = fusion.fused().expect("told");
            assert!((log - 0.004).abs() < 1e-12 && sigma < 0.013, "{source:?}: {log} {sigma}");
        }
    }

    #[test]
    fn a_map_that_takes_over_a_stored_one_knows_who_told_that() {
        let wheels = ScaleSources::default().with(ScaleSource::Wheels);
        let mut fusion = ScaleFusion::default();
        fusion.inherit(&ScaleFusion::restored(0.01, wheels), 0.0, 0.0);
        fusion.rescale(1.0);
        fusion.add(&word(ScaleSource::Wheels, 0.0, 0.01));
        let sources = wheels.with(ScaleSource::StoredMap);
        assert_eq!(fusion.scale(), MapScale::Metric { sigma: 0.01, sources });
    }

    #[test]
    fn many_words_do_not_make_a_measured_height_exact() {
        let mut fusion = ScaleFusion::default();
        (0..100).for_each(|_| assert!(fusion.add(&word(ScaleSource::Height, 0.0, 0.01))));
        let (_, sigma, _) = fusion.fused().expect("told");
        assert!((0.0120..0.0122).contains(&sigma), "{sigma}");
    }

    #[test]
    fn one_wrong_word_is_left_out_and_one_that_is_repeated_is_heard() {
        let mut fusion = ScaleFusion::default();
        (0..5).for_each(|_| assert!(fusion.add(&word(ScaleSource::Height, 0.1, 0.01))));
        assert!(!fusion.add(&word(ScaleSource::Height, 0.5, 0.01)));
        assert!(
            !fusion.add(&word(ScaleSource::Height, f64::NAN, 0.01))
                && !fusion.add(&word(ScaleSource::Height, 0.1, 0.0))
        );
        assert!((fusion.fused().expect("told").0 - 0.1).abs() < 1e-9);
        assert!(
            !fusion.add(&word(ScaleSource::Height, 0.5, 0.01)) && fusion.add(&word(ScaleSource::Height, 0.5, 0.01))
        );
        assert!((fusion.fused().expect("told").0 - 0.5).abs() < 1e-9);
    }
}

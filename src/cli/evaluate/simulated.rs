//! `cairn evaluate --simulator`: the hard cases, one after the other, as a table.

use std::process::ExitCode;

use super::super::session::{self, StatusLine, print};
use super::super::{CliError, exit_code};
use super::args::EvaluateArgs;
use super::drawing::write_comparison;
use crate::atomic_file::write_atomically;
use crate::config::Config;
use crate::evaluation::simulated::{self, CaseResult, cases::cases};
use crate::evaluation::suite::machine_name;

#[derive(serde::Serialize)]
struct Report<'a> {
    machine: String,
    version: &'static str,
    long: bool,
    cases: &'a [CaseResult],
}

fn cannot_write(what: impl std::fmt::Display) -> CliError {
    CliError::new(exit_code::CANNOT_CREATE, what.to_string())
}

/// Runs the suite; fails when a case does not keep its promise.
pub fn run(args: &EvaluateArgs, config: &Config) -> Result<ExitCode, CliError> {
    let mut chosen = Vec::new();
    for seed in args.first_seed..args.first_seed + args.seeds {
        chosen
            .extend(cases(seed).into_iter().filter(|c| args.case.is_empty() || args.case.iter().any(|n| n == c.name)));
    }
    if let Some(unknown) = args.case.iter().find(|name| !cases(args.first_seed).iter().any(|c| c.name == name.as_str()))
    {
        let known: Vec<_> = cases(args.first_seed).iter().map(|c| c.name).collect();
        let message = format!("--case {unknown}: there is no such case; known: {}", known.join(", "));
        return Err(CliError::new(exit_code::USAGE, message));
    }
    std::fs::create_dir_all(&args.output).map_err(|e| cannot_write(format!("{}: {e}", args.output.display())))?;
    let mut line = StatusLine::new(args.result.quiet);
    let mut results: Vec<CaseResult> = Vec::with_capacity(chosen.len());
    for (i, case) in chosen.iter().enumerate() {
        line.show(&format!("[{}/{}] {} seed {}", i + 1, chosen.len(), case.name, case.config.seed));
        let (result, _) = simulated::run_case(case, args.long, &config.features, &config.reconstruction, &args.output)
            .map_err(|e| cannot_write(format!("{}: {e}", case.name)))?;
        if let Some(outcome) = &result.outcome {
            let path = args.output.join(format!("{}-{}.png", case.name, case.config.seed));
            write_comparison(&path, outcome, case.name).map_err(cannot_write)?;
        }
        results.push(result);
    }
    let table = simulated::table(&results);
    let report =
        Report { machine: machine_name(), version: env!("CARGO_PKG_VERSION"), long: args.long, cases: &results };
    let json = session::json(&report)?;
    let file = |name: &str, text: &str| {
        write_atomically(&args.output.join(name), |out| std::io::Write::write_all(out, text.as_bytes()))
            .map_err(cannot_write)
    };
    file("simulator.md", &table)?;
    file("simulator.json", &json)?;
    line.clear();
    print(if args.result.json { &json } else { &table })?;
    line.note(&format!("table, figures, trajectories and pictures: {}", args.output.display()));
    match results.iter().filter(|r| !r.missed.is_empty()).count() {
        0 => Ok(ExitCode::SUCCESS),
        n => Err(CliError::new(
            exit_code::FAILURE,
            format!("{n} of {} cases missed a limit, see the table", results.len()),
        )),
    }
}

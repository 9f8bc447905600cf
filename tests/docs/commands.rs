//! Command lines of `cairn` as the pages show them, and whether the program would take them.
//!
//! In a block of `sh` they stand as they are typed. A code span may also show a form:
//!
//! | in a span | stands for |
//! |---|---|
//! | a word of capitals of [`PLACEHOLDERS`] | any such value; with `...` at its end, several |
//! | `[--option VALUE]` | may be left out |
//! | `...` at the end | the rest, required arguments too |
//! | a subcommand alone | its name |

use clap::Parser;
use clap::error::ErrorKind;

/// Words of capitals, and a value that each may have.
const PLACEHOLDERS: [(&str, &str); 18] = [
    ("DIR", "folder"),
    ("OUT.mcap", "out.mcap"),
    ("FILE.mcap", "file.mcap"),
    ("FILE", "file.txt"),
    ("PATH", "folder"),
    ("A", "a.png"),
    ("B", "b.png"),
    ("ESTIMATE", "path.txt"),
    ("GROUNDTRUTH", "truth.txt"),
    ("PREFIX", "front"),
    ("NAME", "blackout"),
    ("N", "3"),
    ("SECONDS", "30"),
    ("PX", "0.5"),
    ("X", "-1.5"),
    ("Y", "0.5"),
    ("YAW", "-90"),
    ("LEVEL", "debug"),
];
/// The packages' names of the program.
const PROGRAMS: [&str; 3] = ["cairn", "cairn-tools", "cairn-bridge"];

/// The commands of a shell's text, each as its words: quotes are undone, comments left out, lines that end with a backslash joined.
pub fn shell(text: &str) -> Vec<Vec<String>> {
    let mut commands = vec![Vec::new()];
    let (mut word, mut quote) = (None::<String>, None);
    let joined = text.replace("\\\n", " ");
    let mut characters = joined.chars().peekable();
    while let Some(c) = characters.next() {
        let between = word.is_none();
        match (quote, c) {
            (Some(open), _) if c == open => quote = None,
            (Some(_), _) => word.get_or_insert_default().push(c),
            (None, '\'' | '"') => {
                quote = Some(c);
                word.get_or_insert_default();
            }
            (None, '#') if between => while characters.next_if(|c| *c != '\n').is_some() {},
            (None, '\n' | ';' | '|' | '&' | ' ') => {
                let last = commands.len() - 1;
                commands[last].extend(word.take());
                if c != ' ' {
                    commands.push(Vec::new());
                }
            }
            (None, _) => word.get_or_insert_default().push(c),
        }
    }
    let last = commands.len() - 1;
    commands[last].extend(word);
    commands.retain(|words| !words.is_empty());
    commands
}

/// The arguments, if these words run `cairn`: by its name, by a path to it, by `cargo run`, with `sudo`, `timeout` or variables before it.
pub fn arguments(words: &[String]) -> Option<&[String]> {
    let mut words = words;
    loop {
        match words {
            [first, rest @ ..] if first.split_once('=').is_some_and(|(name, _)| name.chars().all(is_of_a_variable)) => {
                words = rest;
            }
            [sudo, option, _, rest @ ..] if sudo == "sudo" && option == "-u" => words = rest,
            [sudo, rest @ ..] if sudo == "sudo" => words = rest,
            [timeout, rest @ ..] if timeout == "timeout" => {
                words = &rest[rest.iter().position(|word| word.parse::<f64>().is_ok())? + 1..];
            }
            [cargo, run, rest @ ..] if cargo == "cargo" && run == "run" => {
                let end = rest.iter().position(|word| word == "--")?;
                return (!rest[..end].contains(&"--example".to_owned())).then_some(&rest[end + 1..]);
            }
            [first, rest @ ..] => {
                let name = first.rsplit('/').next()?;
                return PROGRAMS.contains(&name).then_some(rest);
            }
            [] => return None,
        }
    }
}

fn is_of_a_variable(c: char) -> bool {
    c.is_ascii_uppercase() || c == '_'
}

/// What is wrong with the arguments of a command that stands in a block.
pub fn fault(arguments: &[String]) -> Option<String> {
    let arguments = arguments.iter().filter(|word| !word.starts_with('>') && !word.starts_with("2>"));
    let error = refusal(arguments.map(String::as_str))?;
    let told = matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion);
    (!told).then(|| error.to_string())
}

/// Why this build does not take a line. One for a command that another build has is tried in that one: CI runs this test in both.
fn refusal<'a>(arguments: impl Iterator<Item = &'a str>) -> Option<clap::Error> {
    let error = cairn::cli::Arguments::try_parse_from(std::iter::once("cairn").chain(arguments)).err()?;
    cairn::cli::elsewhere(&error).is_none().then_some(error)
}

/// What is wrong with a form, as code spans show it.
pub fn fault_of_form(arguments: &[String]) -> Option<String> {
    let (open_end, arguments) = match arguments {
        [rest @ .., last] if last == "..." => (true, rest),
        [name] => (true, std::slice::from_ref(name)),
        all => (false, all),
    };
    let all: Vec<String> = arguments.iter().map(|word| word.trim_matches(['[', ']']).to_owned()).collect();
    let mut needed = Vec::new();
    let mut inside = false;
    for word in arguments {
        inside |= word.starts_with('[');
        if !inside {
            needed.push(word.clone());
        }
        inside &= !word.ends_with(']');
    }
    [all, needed].into_iter().find_map(|words| {
        let filled: Result<Vec<_>, String> = words.iter().map(|word| filled(word)).collect();
        match filled {
            Err(unknown) => Some(unknown),
            Ok(words) if open_end => open_fault(&words),
            Ok(words) => fault(&words),
        }
    })
}

/// As [`fault`], but more may follow.
fn open_fault(words: &[String]) -> Option<String> {
    let error = refusal(words.iter().map(String::as_str))?;
    let missing = matches!(
        error.kind(),
        ErrorKind::MissingRequiredArgument
            | ErrorKind::MissingSubcommand
            | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
            | ErrorKind::InvalidValue
    ) && (error.kind() != ErrorKind::InvalidValue || error.to_string().contains("a value is required"));
    (!missing).then(|| error.to_string())
}

/// A placeholder's value, or the word itself.
fn filled(word: &str) -> Result<String, String> {
    let name = word.trim_end_matches("...");
    if let Some((_, value)) = PLACEHOLDERS.iter().find(|(placeholder, _)| *placeholder == name) {
        return Ok((*value).to_owned());
    }
    let capitals = !name.is_empty() && name.chars().all(|c| c.is_ascii_uppercase() || c == '_');
    if capitals { Err(format!("`{name}` is no placeholder that is known")) } else { Ok(word.to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(line: &str) -> Vec<String> {
        shell(line).remove(0)
    }
    fn form(line: &str) -> Option<String> {
        fault_of_form(arguments(&words(line)).expect("cairn"))
    }

    #[test]
    fn a_shell_line_falls_into_commands_and_words() {
        let found = shell("A=1 sudo -u x cairn 'a && b' \\\n  c # d\n\nls | cairn-tools e; f&& g");
        let expected: [&[&str]; 5] =
            [&["A=1", "sudo", "-u", "x", "cairn", "a && b", "c"], &["ls"], &["cairn-tools", "e"], &["f"], &["g"]];
        assert_eq!(found, expected);
        assert_eq!(arguments(&found[0]), Some(&["a && b".to_owned(), "c".to_owned()][..]));
        assert_eq!(arguments(&found[1]), None);
        assert_eq!(arguments(&found[2]), Some(&["e".to_owned()][..]));
        assert_eq!(arguments(&words("timeout -s INT 5 cairn run")), Some(&["run".to_owned()][..]));
        assert_eq!(arguments(&words("cargo run --release -- demo")), Some(&["demo".to_owned()][..]));
        assert_eq!(arguments(&words("cargo run --example planner -- demo")), None);
        assert_eq!(arguments(&words("target/release/cairn watch")), Some(&["watch".to_owned()][..]));
    }

    #[test]
    fn commands_that_the_program_refuses_are_found() {
        assert_eq!(fault(&words("demo --seconds 20 2>/dev/null")), None);
        assert_eq!(fault(&words("demo --help")), None);
        for wrong in ["dmeo", "demo --second 20", "demo --seconds N", "twoview a.png", "command", "demo --output"] {
            assert!(fault(&words(wrong)).is_some(), "{wrong}");
        }
    }

    #[test]
    fn a_command_of_another_build_is_tried_in_that_one_alone() {
        for right in ["cairn-bridge bridge --robot r", "cairn bridge --no-commands"] {
            assert_eq!(fault(arguments(&words(right)).expect("cairn")), None, "{right}");
        }
        assert_eq!(form("cairn bridge"), None);
        let wrong = fault(&words("bridge --robots r"));
        assert_eq!(wrong.is_some(), cfg!(feature = "bridge"), "{wrong:?}");
    }

    #[test]
    fn forms_are_tried_with_values_and_with_and_without_what_is_optional() {
        for right in [
            "cairn demo [--seconds N] [--output DIR]",
            "cairn compare PATH... --output DIR",
            "cairn calibrate ...",
            "cairn twoview A B ...",
            "cairn command set-pose X Y YAW",
            "cairn evaluate --suite ...",
            "cairn twoview",
        ] {
            assert_eq!(form(right), None, "{right}");
        }
        for wrong in [
            "cairn demo [--second N]",
            "cairn twoview A [B] --output DIR",
            "cairn twoview A B",
            "cairn demo --seconds THING",
            "cairn calibrat ...",
            "cairn calibrat",
            "cairn demo --seconds many ...",
        ] {
            assert!(form(wrong).is_some(), "{wrong}");
        }
    }
}

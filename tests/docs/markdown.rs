//! As much of Markdown as our pages use: fenced blocks, code spans, headings, links.

/// A fenced block.
#[derive(Debug, PartialEq)]
pub struct Block {
    /// Line of the opening fence, from 1.
    pub line: usize,
    pub language: String,
    /// What the comment `<!-- ... -->` on the line above the fence says.
    pub marker: Option<String>,
    pub text: String,
}

/// A page taken apart.
#[derive(Debug, Default)]
pub struct Page {
    pub blocks: Vec<Block>,
    /// Code spans outside blocks, with the line of the paragraph that they are in.
    pub spans: Vec<(usize, String)>,
    /// Targets of links and pictures, with the line of their paragraph.
    pub links: Vec<(usize, String)>,
    /// What `#...` can name.
    pub anchors: Vec<String>,
}

/// A fence must be closed, or the rest of the page would be code.
pub fn read(text: &str) -> Result<Page, String> {
    let mut page = Page::default();
    let mut paragraph = (0, String::new());
    let mut open: Option<Block> = None;
    let mut before = "";
    for (number, line) in text.lines().enumerate().map(|(i, line)| (i + 1, line)) {
        let trimmed = line.trim();
        if let Some(mut block) = open.take() {
            if trimmed == "```" {
                page.blocks.push(block);
            } else {
                block.text += &format!("{trimmed}\n");
                open = Some(block);
            }
        } else if let Some(language) = trimmed.strip_prefix("```") {
            page.paragraph(&std::mem::take(&mut paragraph));
            let marker = before.strip_prefix("<!--").and_then(|rest| rest.strip_suffix("-->"));
            let marker = marker.map(|words| words.trim().to_owned());
            open = Some(Block { line: number, language: language.to_owned(), marker, text: String::new() });
        } else if trimmed.is_empty() {
            page.paragraph(&std::mem::take(&mut paragraph));
        } else if line.starts_with('#') {
            page.paragraph(&std::mem::take(&mut paragraph));
            page.heading(line.trim_start_matches('#').trim());
            page.paragraph(&(number, line.to_owned()));
        } else {
            if paragraph.1.is_empty() {
                paragraph.0 = number;
            }
            paragraph.1 += &format!("{line}\n");
        }
        before = trimmed;
    }
    page.paragraph(&paragraph);
    match open {
        Some(block) => Err(format!("line {}: this fence is not closed", block.line)),
        None => Ok(page),
    }
}

impl Page {
    fn heading(&mut self, title: &str) {
        let anchor = anchor(title);
        let again = self.anchors.iter().filter(|known| **known == anchor).count();
        self.anchors.push(anchor);
        if again > 0 {
            let last = self.anchors.len() - 1;
            self.anchors[last] += &format!("-{again}");
        }
    }

    /// Code spans, then links in what is left.
    fn paragraph(&mut self, (line, text): &(usize, String)) {
        let mut prose = String::new();
        let mut rest = text.as_str();
        while let Some(begin) = rest.find('`') {
            let ticks = rest[begin..].chars().take_while(|c| *c == '`').count();
            let inside = &rest[begin + ticks..];
            let Some(end) = inside.find(&"`".repeat(ticks)) else { break };
            prose += &rest[..begin];
            let words: Vec<_> = inside[..end].split_whitespace().collect();
            self.spans.push((*line, words.join(" ")));
            rest = &inside[end + ticks..];
        }
        prose += rest;
        for (at, _) in prose.match_indices("](") {
            if let Some(end) = prose[at..].find(')') {
                let target: String = prose[at + 2..at + end].split_whitespace().collect();
                self.links.push((*line, target));
            }
        }
    }
}

/// GitHub's: lower case, letters, digits, `-` and `_` stay, blanks become `-`.
fn anchor(title: &str) -> String {
    let kept = title.to_lowercase();
    let kept = kept.chars().filter(|c| c.is_alphanumeric() || matches!(c, '-' | '_' | ' '));
    kept.map(|c| if c == ' ' { '-' } else { c }).collect()
}

#[test]
fn a_page_is_taken_apart() {
    let page = read(
        "# What, `it` is!\ntext [with `code`](a.md#b), `two\nlines`\n\n  <!-- try -->\n  ```sh\n  ls `x` [y](z)\n  ```\n## Again\n## Again\n",
    )
    .expect("a page");
    assert_eq!(page.anchors, ["what-it-is", "again", "again-1"]);
    assert_eq!(page.spans, [(1, "it".into()), (2, "code".into()), (2, "two lines".into())]);
    assert_eq!(page.links, [(2, "a.md#b".into())]);
    let block = Block { line: 6, language: "sh".into(), marker: Some("try".into()), text: "ls `x` [y](z)\n".into() };
    assert_eq!(page.blocks, [block]);
    assert!(read("```sh\nls\n").is_err_and(|e| e.contains("line 1")));
}

//! Converts prompts and completions to and from token ids with the checkpoint's tokenizer and
//! prompt template.

use std::path::Path;

use anyhow::{Result, anyhow, ensure};

use crate::checkpoint::config::Config;

/// The single space of a Llama tokenizer, which separates a prompt (or `ACTION:`) from action
/// tokens.
pub const LLAMA_SPACE: u32 = 29871;
const LLAMA_SPACE_TEXT: &str = "▁";

/// Encodes instructions as prompts and decodes completions.
pub struct Prompter {
    tokenizer: tokenizers::Tokenizer,
    template: String,
    first: u32,
    /// Whether the prompt ends with a space: Llama's vocabulary without reasoning.
    space_ends_prompt: bool,
    /// The first tag, if the prompt template already contains it.
    opened: &'static str,
}

impl Prompter {
    /// Loads `tokenizer.json`.
    pub fn load(path: &Path, config: &Config) -> Result<Prompter> {
        let tokenizer = tokenizers::Tokenizer::from_file(path)
            .map_err(|error| anyhow!("cannot read {}: {error}", path.display()))?;
        let size = tokenizer.get_vocab_size(true);
        ensure!(
            size == config.vocabulary || size == config.vocabulary + 1,
            "tokenizer.json: expected {} tokens and at most one for padding, got {size}",
            config.vocabulary
        );
        let llama = tokenizer.id_to_token(LLAMA_SPACE).as_deref() == Some(LLAMA_SPACE_TEXT);
        let opened = if config.prompt_template.ends_with("TASK:") { "TASK:" } else { "" };
        Ok(Prompter {
            tokenizer,
            template: config.prompt_template.clone(),
            first: config.text.bos_token_id,
            space_ends_prompt: llama && !config.reasoning,
            opened,
        })
    }

    /// The first token and the prompt. The image tokens are inserted between the first token and
    /// the rest.
    pub fn ids(&self, instruction: &str) -> Result<Vec<u32>> {
        let text = self.template.replace("{instruction}", &instruction.to_lowercase());
        let encoding = self
            .tokenizer
            .encode(text, true)
            .map_err(|error| anyhow!("cannot tokenize instruction {instruction:?}: {error}"))?;
        let mut ids = encoding.get_ids().to_vec();
        if ids.first() != Some(&self.first) {
            ids.insert(0, self.first);
        }
        if self.space_ends_prompt && ids.last() != Some(&LLAMA_SPACE) {
            ids.push(LLAMA_SPACE);
        }
        Ok(ids)
    }

    /// Whether the text of an id contains a colon.
    pub fn has_colon(&self, id: u32) -> bool {
        self.tokenizer.id_to_token(id).is_some_and(|text| text.contains(':'))
    }

    /// The text of a completion, including the tag that the prompt may have opened.
    pub fn text(&self, ids: &[u32]) -> String {
        // All ids are in the vocabulary, so only a broken decoder in tokenizer.json can fail here.
        match self.tokenizer.decode(ids, false) {
            Ok(text) => format!("{}{text}", self.opened),
            Err(error) => format!("(tokenizer.json cannot decode {ids:?}: {error})"),
        }
    }
}

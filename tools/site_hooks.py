"""What mkdocs calls while it builds the site: adds the generated pages, and checks every link of the result."""

import re
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).parent))
from links import dead_links
from reference import pages, policy_facts

FACTS = re.compile(r"<!-- facts of ([\w-]+) -->")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are written from the code."""
    for path, text in pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Puts what a policy file says of itself in its place."""
    return FACTS.sub(lambda match: policy_facts(match[1]), markdown)


def on_post_build(config: MkDocsConfig) -> None:
    """Ends the build when a link of a page leads nowhere.

    Raises:
      PluginError: names the pages and their dead links.
    """
    if dead := dead_links(Path(config.site_dir)):
        raise PluginError("dead links:\n" + "\n".join(dead))

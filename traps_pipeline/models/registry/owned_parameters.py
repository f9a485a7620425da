"""Refuse parameters of an entry that the protocol or the client sets itself.

Each would change what is asked, how many answers are paid for, or the form in which they come, while the ledger's key,
the budget and the reader go on as before.
"""

import re
from collections.abc import Mapping
from typing import Any

# Names of all providers and of the client library, without case and punctuation, by the reason why they are refused.
_OWNED: Mapping[str, str] = {
    "a call asks for one answer, and the budget counts one": (
        "n bestof candidatecount numreturnsequences numgenerations numcompletions numoutputs numsamples resultcount "
        "usebeamsearch numbeams beamwidth nprobs"
    ),
    "an answer is read whole": "stream streaming streamoptions incrementaloutput background async deferred",
    "prompts and clip make the call, and nothing else": (
        "model models messages prompt input inputs contents content system systemprompt systeminstruction instructions "
        "question query suffix prefix prefill echo documents files attachments context chathistory history preamble "
        "previousresponseid conversation conversationid cachedcontent promptid plugins transforms"
    ),
    "a model answers from the clip alone": (
        "tools tool toolchoice toolconfig functions function functioncall functioncalling paralleltoolcalls "
        "maxtoolcalls websearch websearchoptions enablesearch searchoptions searchparameters searchmode connectors "
        "codeexecution mcpservers datasources grounding"
    ),
    "the regime sets the form of an answer": (
        "responseformat responseschema responsejsonschema responsemimetype outputformat outputschema outputconfig "
        "generationconfig format grammar jsonschema jsonobject jsonmode structuredoutputs structuredoutput guidedjson "
        "guidedchoice guidedregex guidedgrammar guideddecodingbackend text textformat modalities responsemodalities "
        "audio prediction continuefinalmessage addgenerationprompt"
    ),
    "the protocol's name for it is `max_tokens`, or `max_completion_tokens`": (
        "maxoutputtokens maxnewtokens maxgenlen maxlength maxtokenstosample maxgenerationlength numpredict npredict "
        "maxgeneratedtokens"
    ),
    "the client sets it, and no call is made behind the ledger": (
        "timeout requesttimeout streamtimeout numretries maxretries retrypolicy fallbacks contextwindowfallbackdict "
        "contentpolicyfallbacks mockresponse mocktimeout mocktoolcalls customllmprovider client acompletion cache "
        "caching callbacks successcallback failurecallback loggerfn hooks router deploymentid sslverify proxy "
        "dropparams additionaldropparams guardrails modellist organization extraquery"
    ),
}
_REASONS = {name: reason for reason, names in _OWNED.items() for name in names.split()}
# Fields whose content goes into the body as it is. `parameters` and `options` are those of other APIs than OpenAI's.
_INTO_BODY = ("extrabody", "parameters", "options", "allowedopenaiparams")
_SENT_ONCE = ("temperature", "topp", "maxtokens", "maxcompletiontokens")  # sent by the protocol, refused a second time


def check_owned_parameters(params: Mapping[str, Any]) -> None:
    """Raise ValueError for a parameter that the protocol or the client owns."""
    for path, name in _names(params, ""):
        plain_name = re.sub(r"[^a-z0-9]", "", name.lower())
        if plain_name in _REASONS:
            raise ValueError(f"params.{path}: {_REASONS[plain_name]}; remove it")
        if plain_name in _SENT_ONCE and path != plain_name and "." in path:
            raise ValueError(f"params.{path}: is sent as params.{name}, where the protocol's value is checked; move it")


def _names(params: Mapping[str, Any], above: str) -> list[tuple[str, str]]:
    """Return the path and name of each parameter, with those of fields that go into the body."""
    names = list[tuple[str, str]]()
    for name, value in params.items():
        path = f"{above}{name}"
        names.append((path, str(name)))
        if re.sub(r"[^a-z]", "", str(name).lower()) in _INTO_BODY:
            listed = dict.fromkeys(value) if isinstance(value, list) else value
            names += _names(listed, f"{path}.") if isinstance(listed, Mapping) else []
    return names

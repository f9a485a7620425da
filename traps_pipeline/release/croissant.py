"""Describe a release in Croissant 1.1, with the fields of responsible AI."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import file_digest
from traps_pipeline.storage.tables import StoredColumn, Table

CONFORMS_TO = ["http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0"]
# The context that the standard prescribes.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    **{
        name: f"cr:{name}"
        for name in (
            *("arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field"),
            *("fileProperty", "fileObject", "fileSet", "format", "includes", "isArray", "isLiveDataset", "jsonPath"),
            *("key", "md5", "parentField", "path", "recordSet", "references", "regex", "repeated", "replace"),
            *("samplingRate", "separator", "source", "subField", "transform"),
        )
    },
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
}
_TYPES = {str: "sc:Text", int: "sc:Integer", float: "sc:Float", bool: "sc:Boolean", list[str]: "sc:Text"}
_RAI: Mapping[str, Any] = {
    "rai:dataCollection": "Scenes are drawn from parametric families, simulated with MuJoCo, and rendered; nothing is "
    "recorded and no person takes part.",
    "rai:dataCollectionType": ["Synthetic: physics simulation"],
    "rai:dataCollectionRawData": "Records of scenarios with frozen trajectories; table `scenarios`.",
    "rai:dataAnnotationProtocol": "Ground truth is read from the simulator's state by code. Every pair has "
    "certificates that its control shows the outcome and that its void does not (table `certificates`).",
    "rai:machineAnnotationTools": ["the simulator's state"],
    "rai:annotationsPerItem": "1, made by code",
    "rai:dataManipulationProtocol": "A void is made from its control by one change: a panel, an earlier end, or "
    "another question.",
    "rai:dataUseCases": [
        "Comparing models and prompts by whether they answer what can be seen and abstain where nothing can be known.",
        "Not for training: a model that was trained on it cannot be evaluated with it.",
    ],
    "rai:dataLimitations": [
        "Scenes are synthetic rigid bodies; how far results carry over to real video is not measured.",
        "Each void of a pair is made by one kind of change, which can be recognised; two events balance such cues.",
        "A high PECS is no proof that a model is safe or honest.",
    ],
    "rai:dataBiases": [
        "Two taxonomies of voids and few kinds of scenes; questions and answers are in English.",
        "Answers are balanced within families, so that the commonest answer earns little.",
    ],
    "rai:dataSocialImpact": "Models that claim what they cannot know mislead people; the dataset measures that. "
    "It shows no people and holds nothing sensitive.",
    "rai:personalSensitiveInformation": ["None: nobody is shown or named."],
    "rai:dataReleaseMaintenancePlan": "Versions are a function of content; corrections raise the version of the "
    "part that they change.",
}

_RECORDED_RAI: Mapping[str, Any] = {
    "rai:dataCollection": "Video that the publisher brought; columns `source` and `licence` of `pairs`.",
    "rai:dataAnnotationProtocol": "The publisher states the answers; people certify pairs (table `certificates`).",
    "rai:dataLimitations": ["No simulator proves a void; pairs that people do not certify are not certified."],
    "rai:personalSensitiveInformation": ["Clips may show people; ask the publisher."],
}


def croissant(root: Path, manifest: Mapping[str, Any], tables: Sequence[Table[Any]], places: Mapping[str, str]) -> str:
    """Return the JSON-LD description of a folder that already holds the tables."""
    document: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": manifest["name"],
        "description": "Matched pairs of clips and questions: a control whose outcome can be seen, and a void in which "
        f"one change makes it impossible to determine. Canary: {manifest['canary']}",
        "conformsTo": CONFORMS_TO,
        "license": [
            "LICENSE-DATA" if manifest.get("recorded") else "https://creativecommons.org/licenses/by/4.0/",
            "https://creativecommons.org/licenses/by-nc/4.0/",
        ],
        "version": manifest["version"],
        "citeAs": "See CITATION.cff.",
        "creator": {"@type": "sc:Organization", "name": _creator(manifest)},
        "inLanguage": ["en"],
        "keywords": ["abstention", "benchmark", "video question answering", "vision-language models"],
        "isLiveDataset": False,
        **({"datePublished": manifest["date"]} if manifest["date"] else {}),
        **(_RECORDED_RAI if manifest.get("recorded") else _RAI),
        "distribution": [*_files(root, tables, places), _clips()],
        "recordSet": [_record_set(table, places[table.name]) for table in tables],
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _creator(manifest: Mapping[str, Any]) -> str:
    return "Anonymous authors" if manifest["anonymous"] else "The maintainers of TRAPSBench"


def _files(root: Path, tables: Sequence[Table[Any]], places: Mapping[str, str]) -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileObject",
            "@id": places[table.name],
            "name": table.name,
            "contentUrl": places[table.name],
            "encodingFormat": "application/jsonlines",
            "sha256": file_digest(root / places[table.name]),
        }
        for table in tables
    ]


def _clips() -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": "clips",
        "name": "clips",
        "description": "Every clip once; its checksum stands in SHA256SUMS.",
        "encodingFormat": "video/mp4",
        "includes": "clips/*/*.mp4",
    }


def _record_set(table: Table[Any], place: str) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": table.name,
        "name": table.name,
        "description": f"One record is {table.row}.",
        "key": [{"@id": f"{table.name}/{name}"} for name in table.key],
        "field": [_field(table, column, place) for column in table.columns],
    }


def _field(table: Table[Any], column: StoredColumn, place: str) -> dict[str, Any]:
    array_properties = {"isArray": True, "arrayShape": "-1"} if column.type == list[str] else {}
    return {
        "@type": "cr:Field",
        "@id": f"{table.name}/{column.name}",
        "name": column.name,
        "description": column.doc,
        "dataType": _TYPES[column.type],
        **array_properties,
        "source": {"fileObject": {"@id": place}, "extract": {"column": column.name}},
    }

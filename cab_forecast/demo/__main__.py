"""Command that prints the demo request as JSON: ``python -m cab_forecast.demo > demo.json``."""

import sys

from google.protobuf import json_format

from cab_forecast.demo import demo_request

sys.stdout.write(json_format.MessageToJson(demo_request(), preserving_proto_field_name=True) + "\n")

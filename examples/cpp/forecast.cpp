// Forecasts two road users over gRPC and prints their most likely futures.
//
//   forecast [HOST:PORT] [--ca FILE] [--key KEY] [--deadline SECONDS] [--horizon SECONDS]
//
// --ca makes the connection TLS and trusts the certificates in that PEM file. --key is the API key.
// Exit status: 0 forecasts were made, 1 the call failed, 2 the arguments are wrong.

#include <google/rpc/error_details.pb.h>
#include <grpcpp/grpcpp.h>

#include <chrono>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>

#include "cab/forecast/v1/prediction_service.grpc.pb.h"

namespace pb = cab::forecast::v1;

namespace {

struct Arguments {
  std::string endpoint = "127.0.0.1:50051";
  std::string ca_file;  // empty: no TLS
  std::string key;      // empty: the server asks for none
  double deadline = 1.0;  // s
  double horizon = 0.0;   // s; 0: the model's
};

// A patch of the map in one agent's frame: 100 × 100 pixels at 3 pixels per metre. Row i, column j shows the point
// (i - 10) / 3 m ahead of the agent and (j - 50) / 3 m to its left.
class MapPatch {
 public:
  enum Layer { kDriveableArea, kRoadDividers, kLaneDividers };

  // Sets the pixels of a layer between two distances to the left of the agent, m, all along the patch.
  void SetBand(Layer layer, double right, double left) {
    for (int row = 0; row < kPixels; ++row) {
      for (int column = 0; column < kPixels; ++column) {
        const double to_the_left = (column - 50) / kPixelsPerMeter;
        if (right <= to_the_left && to_the_left <= left) Set(layer, row, column);
      }
    }
  }

  pb::MapPatch Message() const {
    pb::MapPatch message;
    message.mutable_image()->set_packed_bits(bits_);
    return message;
  }

 private:
  static constexpr int kPixels = 100;
  static constexpr double kPixelsPerMeter = 3.0;

  // Bits in the order [layer, row, column], eight a byte, the first in the highest bit.
  void Set(Layer layer, int row, int column) {
    const int bit = (layer * kPixels + row) * kPixels + column;
    bits_[bit / 8] |= static_cast<char>(0x80 >> (bit % 8));
  }

  std::string bits_ = std::string((3 * kPixels * kPixels + 7) / 8, '\0');
};

// Adds an agent that has driven at a constant velocity, seen at 2 Hz for the last 2 s.
pb::Agent* AddAgent(pb::PredictRequest& request, const std::string& id, pb::AgentType type, double x, double y,
                    double velocity_x, double velocity_y) {
  pb::Agent* agent = request.add_agents();
  agent->set_id(id);
  agent->set_type(type);
  for (int frame = -4; frame <= 0; ++frame) {  // oldest first
    const double before = 0.5 * frame;
    pb::AgentState* state = agent->add_states();
    state->set_time(request.time() + before);
    state->set_x(x + velocity_x * before);
    state->set_y(y + velocity_y * before);
    state->set_heading(std::atan2(velocity_y, velocity_x));
    state->set_velocity_x(velocity_x);
    state->set_velocity_y(velocity_y);
  }
  return agent;
}

pb::PredictRequest MakeRequest(const Arguments& arguments) {
  pb::PredictRequest request;
  request.set_time(std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count());
  request.mutable_options()->set_merge(true);  // modes that a planner would not tell apart as one
  request.mutable_options()->set_priority(5);
  if (arguments.horizon != 0.0) request.mutable_options()->set_horizon(arguments.horizon);

  MapPatch road;  // two lanes ahead and behind: the car's own, and one on its left for the other direction
  road.SetBand(MapPatch::kDriveableArea, -1.75, 5.25);
  road.SetBand(MapPatch::kRoadDividers, 1.5, 2.0);
  *AddAgent(request, "car", pb::AGENT_TYPE_VEHICLE, 0, 0, 8, 0)->mutable_map_patch() = road.Message();
  AddAgent(request, "walker", pb::AGENT_TYPE_PEDESTRIAN, 30, 5, 0, -1.2);
  return request;
}

void Print(const pb::PredictResponse& response) {
  std::cout << std::fixed << std::setprecision(2);
  std::cout << "model " << response.model().name() << "@" << response.model().version() << ", "
            << response.timing().inference() * 1e3 << " ms in the model\n";
  for (const pb::AgentForecast& forecast : response.forecasts()) {
    std::cout << forecast.agent_id() << " " << pb::ForecastStatus_Name(forecast.status());
    if (!forecast.detail().empty()) std::cout << " (" << forecast.detail() << ")";
    std::cout << "\n";
    for (const pb::InputWarning& warning : forecast.warnings()) std::cout << "  warning: " << warning.detail() << "\n";
    if (forecast.weights_size() == 0) continue;  // INVALID: there is no forecast
    const int steps = static_cast<int>(response.steps());
    const int mode = static_cast<int>(forecast.most_likely_mode());
    std::cout << "  " << forecast.weights_size() << " modes; the likeliest one has probability "
              << forecast.weights(mode) << "\n";
    for (int step = 1; step < steps; step += 2) {  // every second
      const int at = mode * steps + step;
      const double sigma_x = std::sqrt(forecast.covariances(at * 3));
      const double sigma_y = std::sqrt(forecast.covariances(at * 3 + 2));
      std::cout << "  in " << (step + 1) * response.step() << " s: x " << forecast.means(at * 2) << " ± " << sigma_x
                << " m, y " << forecast.means(at * 2 + 1) << " ± " << sigma_y << " m\n";
    }
  }
  for (const std::string& warning : response.warnings()) std::cout << "warning: " << warning << "\n";
}

// Prints the status of a failed call and the google.rpc details that came with it.
void PrintError(const grpc::Status& status) {
  std::cerr << "code " << status.error_code() << ": " << status.error_message() << "\n";
  google::rpc::Status rich;
  if (!rich.ParseFromString(status.error_details())) return;
  for (const google::protobuf::Any& detail : rich.details()) {
    google::rpc::ErrorInfo info;
    google::rpc::BadRequest bad_request;
    google::rpc::RetryInfo retry;
    google::rpc::RequestInfo request;
    if (detail.UnpackTo(&info)) {
      std::cerr << "reason " << info.reason() << "\n";
    } else if (detail.UnpackTo(&bad_request)) {
      for (const auto& violation : bad_request.field_violations()) {
        std::cerr << "field " << violation.field() << ": " << violation.description() << "\n";
      }
    } else if (detail.UnpackTo(&retry)) {
      std::cerr << "retry in " << retry.retry_delay().seconds() + retry.retry_delay().nanos() * 1e-9 << " s\n";
    } else if (detail.UnpackTo(&request)) {
      std::cerr << "request " << request.request_id() << "\n";  // by which the server's log names the call
    }
  }
}

std::string ReadFile(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw std::invalid_argument("cannot read " + path);
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

std::shared_ptr<grpc::ChannelCredentials> MakeCredentials(const Arguments& arguments) {
  if (arguments.ca_file.empty()) return grpc::InsecureChannelCredentials();
  grpc::SslCredentialsOptions options;
  options.pem_root_certs = ReadFile(arguments.ca_file);
  return grpc::SslCredentials(options);
}

Arguments Parse(int count, char** words) {
  Arguments arguments;
  for (int i = 1; i < count; ++i) {
    const std::string word = words[i];
    if (word.rfind("--", 0) != 0) {
      arguments.endpoint = word;
      continue;
    }
    if (i + 1 == count) throw std::invalid_argument(word + " needs a value");
    const std::string value = words[++i];
    if (word == "--ca") {
      arguments.ca_file = value;
    } else if (word == "--key") {
      arguments.key = value;
    } else if (word == "--deadline") {
      arguments.deadline = std::stod(value);
    } else if (word == "--horizon") {
      arguments.horizon = std::stod(value);
    } else {
      throw std::invalid_argument("unknown option " + word);
    }
  }
  return arguments;
}

int Run(const Arguments& arguments) {
  // In a program that calls again and again, keep channel and stub: connections are opened once.
  const auto channel = grpc::CreateChannel(arguments.endpoint, MakeCredentials(arguments));
  const auto stub = pb::PredictionService::NewStub(channel);

  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() +
                       std::chrono::microseconds(static_cast<long long>(arguments.deadline * 1e6)));
  if (!arguments.key.empty()) context.AddMetadata("authorization", "Bearer " + arguments.key);
  pb::PredictResponse response;
  const grpc::Status status = stub->Predict(&context, MakeRequest(arguments), &response);
  if (!status.ok()) {
    PrintError(status);
    return 1;
  }
  Print(response);
  return 0;
}

}  // namespace

int main(int count, char** words) {
  try {
    return Run(Parse(count, words));
  } catch (const std::invalid_argument& error) {
    std::cerr << error.what() << "\n";
    return 2;
  }
}

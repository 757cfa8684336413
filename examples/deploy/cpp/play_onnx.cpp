// Plays an ONNX policy of Cassie on MuJoCo, with the C interfaces of MuJoCo and ONNX Runtime and nothing else.
//
//   play_onnx policy.onnx cassie.xml SECONDS [NAME=VALUE ...]        for example: 10 forward=1.0
//
// play_onnx.py beside this folder is the same loop in Python; docs/deploy.md explains every quantity.

#include <mujoco/mujoco.h>
#include <onnxruntime_c_api.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <string>
#include <vector>

namespace {

const OrtApi* ort = nullptr;

[[noreturn]] void fail(const std::string& message) {
  std::fprintf(stderr, "error: %s\n", message.c_str());
  std::exit(1);
}

void check(OrtStatus* status) {
  if (status) fail(ort->GetErrorMessage(status));
}

// The file's description: JSON as the exporter writes it, so that looking for a key is enough.
struct Description {
  OrtModelMetadata* metadata = nullptr;
  OrtAllocator* allocator = nullptr;

  std::string operator[](const char* key) const {
    char* text = nullptr;
    check(ort->ModelMetadataLookupCustomMetadataMap(metadata, allocator, key, &text));
    if (!text) fail(std::string("the policy says nothing of ") + key);
    std::string copy(text);
    allocator->Free(allocator, text);
    return copy;
  }
};

// What follows `"key": `; empty where there is no such key.
std::string after(const std::string& json, const std::string& key, size_t from = 0) {
  const std::string quoted = "\"" + key + "\": ";
  const size_t found = json.find(quoted, from);
  return found == std::string::npos ? "" : json.substr(found + quoted.size());
}

// A number of the command line.
double given(const std::string& text, const std::string& where) {
  char* end = nullptr;
  const double value = std::strtod(text.c_str(), &end);
  if (text.empty() || *end || !std::isfinite(value)) fail("got " + where + "; expected a number");
  return value;
}

double number(const std::string& json, const std::string& key, double otherwise = 0) {
  const std::string text = after(json, key);
  return text.empty() ? otherwise : std::strtod(text.c_str(), nullptr);
}

std::vector<double> numbers(const std::string& json, const std::string& key) {
  std::vector<double> values;
  const std::string text = after(json, key);
  const char* place = text.c_str() + 1;
  while (!text.empty() && *place && *place != ']') {
    char* end = nullptr;
    values.push_back(std::strtod(place, &end));
    place = *end == ',' ? end + 1 : end;
  }
  return values;
}

std::string quoted(const std::string& text) { return text.substr(1, text.find('"', 1) - 1); }

std::vector<std::string> words(const std::string& list) {
  std::vector<std::string> found;
  for (size_t start = list.find('"'), close = list.find(']'); start < close;) {
    const size_t end = list.find('"', start + 1);
    found.push_back(list.substr(start + 1, end - start - 1));
    start = list.find('"', end + 1);
  }
  return found;
}

// The rows of a table, each `{"name": ..., ...}` without braces inside.
std::vector<std::string> rows(const std::string& json) {
  std::vector<std::string> found;
  for (size_t start = json.find('{'); start != std::string::npos; start = json.find('{', start + 1)) {
    found.push_back(json.substr(start, json.find('}', start) - start));
  }
  return found;
}

struct Memory {
  double phase = 0, heading = 0;
  bool standing = false;
  std::map<std::string, double> command;
};

bool stands(const mjData* data, const std::string& constants, const Memory& memory) {
  for (const char* name : {"forward", "lateral", "yaw_rate"}) {
    const auto told = memory.command.find(name);
    if (told != memory.command.end() && told->second != 0) return false;
  }
  return std::hypot(data->qvel[0], data->qvel[1]) < number(constants, "stand_below_m_s");
}

// Moves the clock and the heading to keep on by the policy step that has just been simulated.
void advance(const mjData* data, const std::string& constants, double step_s, Memory& memory) {
  if (quoted(after(constants, "command_frame")) == "heading") {
    const mjtNum *q = data->qpos + 3, heading = std::atan2(2 * (q[0] * q[3] + q[1] * q[2]),
                                                           1 - 2 * (q[2] * q[2] + q[3] * q[3]));
    const double limit = number(constants, "max_heading_error_rad");
    const double ahead = memory.heading + memory.command["yaw_rate"] * step_s - heading;
    memory.heading = heading + std::clamp(std::atan2(std::sin(ahead), std::cos(ahead)), -limit, limit);
  }
  if (!memory.standing) {
    const double faster = std::max(std::abs(memory.command["forward"]) - number(constants, "quicken_above_m_s"), 0.0);
    const double cycle_s = number(constants, "cycle_s") + number(constants, "cycle_per_speed_s") * faster;
    memory.phase = std::fmod(memory.phase + step_s / cycle_s, 1.0);
  }
  memory.standing = stands(data, constants, memory);
}

// What the policy sees, in the order of its table.
std::vector<float> observe(const mjModel* model, const mjData* data, const std::vector<std::string>& table,
                           const std::string& constants, const Memory& memory, bool moved) {
  mjtNum upward[9], quat[4], back[4], turned[4];
  mju_copy4(quat, data->qpos + 3);
  mju_quat2Mat(upward, quat);
  double vx = data->qvel[0], vy = data->qvel[1];
  if (quoted(after(constants, "command_frame")) == "heading") {
    const double cos = std::cos(memory.heading), sin = std::sin(memory.heading);
    vx = cos * data->qvel[0] + sin * data->qvel[1];
    vy = cos * data->qvel[1] - sin * data->qvel[0];
    const mjtNum axis[3] = {0, 0, 1};
    mju_axisAngle2Quat(back, axis, -memory.heading);
    mju_mulQuat(turned, back, quat);
    mju_scl(quat, turned, turned[0] < 0 ? -1 : 1, 4);
  }
  const int sensor = mj_name2id(model, mjOBJ_SENSOR, "pelvis-acceleration");
  if (sensor < 0) fail("the model has no sensor pelvis-acceleration");
  const mjtNum* felt = data->sensordata + model->sensor_adr[sensor];
  const double gravity = number(constants, "gravity_m_s2"), angle = 2 * mjPI * memory.phase;

  std::vector<float> seen;
  for (const std::string& row : table) {
    const std::string name = quoted(after(row, "name"));
    const auto add = [&seen](std::initializer_list<double> values) { seen.insert(seen.end(), values.begin(), values.end()); };
    if (name == "pelvis_height") {
      add({data->qpos[2]});
    } else if (name == "pelvis_orientation") {
      add({quat[0], quat[1], quat[2], quat[3]});
    } else if (name == "pelvis_velocity") {
      add({vx, vy, data->qvel[2]});
    } else if (name == "pelvis_angular_velocity") {
      add({data->qvel[3], data->qvel[4], data->qvel[5]});
    } else if (name == "pelvis_acceleration") {
      for (int i = 0; i < 3; ++i) add({moved ? felt[i] - gravity * upward[6 + i] : 0.0});
    } else if (name == "clock") {
      add({memory.standing ? 0 : std::sin(angle), memory.standing ? 0 : std::cos(angle)});
    } else if (name.size() > 8 && name.rfind("_command") == name.size() - 8) {
      add({memory.command.at(name.substr(0, name.size() - 8))});
    } else {
      for (const std::string& part : words(after(row, "parts"))) {
        const int joint = mj_name2id(model, mjOBJ_JOINT, part.c_str());
        if (joint < 0) fail("the model has no joint " + part);
        const bool position = name.find("positions") != std::string::npos;
        add({position ? data->qpos[model->jnt_qposadr[joint]] : data->qvel[model->jnt_dofadr[joint]]});
      }
    }
  }
  return seen;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc < 4) fail("usage: play_onnx POLICY.onnx MODEL.xml SECONDS [NAME=VALUE ...]");
  ort = OrtGetApiBase()->GetApi(ORT_API_VERSION);
  if (!ort) fail("this ONNX Runtime is older than the headers that the program was built with");

  OrtEnv* env = nullptr;
  OrtSessionOptions* options = nullptr;
  OrtSession* session = nullptr;
  OrtMemoryInfo* cpu = nullptr;
  Description about;
  check(ort->CreateEnv(ORT_LOGGING_LEVEL_WARNING, "play_onnx", &env));
  check(ort->CreateSessionOptions(&options));
  check(ort->SetIntraOpNumThreads(options, 1));
  check(ort->CreateSession(env, argv[1], options, &session));
  check(ort->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &cpu));
  check(ort->GetAllocatorWithDefaultOptions(&about.allocator));
  check(ort->SessionGetModelMetadata(session, &about.metadata));

  const std::string constants = about["constants"], control = about["control"], network = about["network"];
  if (control == "null") fail("policy: its actions are added to a reference, which this loop does not have");
  const std::vector<std::string> table = rows(about["observation"]);
  const double rate_hz = std::strtod(about["policy_rate_hz"].c_str(), nullptr), lowest = number(constants, "min_height_m");
  const std::vector<double> scale = numbers(control, "scale"), offset = numbers(control, "offset");
  Memory memory;
  for (const std::string& row : rows(about["commands"])) {
    memory.command[quoted(after(row, "name"))] = number(row, "default");
  }
  for (int i = 4; i < argc; ++i) {
    const std::string item = argv[i], name = item.substr(0, item.find('='));
    if (!memory.command.count(name) || name == item) fail("got " + item + "; it is no NAME=VALUE of a command");
    memory.command[name] = given(item.substr(name.size() + 1), item);
  }

  char message[1000] = "";
  mjModel* model = mj_loadXML(argv[2], nullptr, message, sizeof message);
  if (!model) fail(message);
  mjData* data = mj_makeData(model);
  mj_resetDataKeyframe(model, data, 0);
  if (model->nu != static_cast<int>(offset.size())) fail("the model has another number of actuators than the policy");
  memory.standing = stands(data, constants, memory);

  std::vector<int64_t> carry_shape = {1};
  size_t carry_size = 1;
  for (double width : numbers(network, "carry_shape")) {
    carry_shape.push_back(static_cast<int64_t>(width));
    carry_size *= static_cast<size_t>(width);
  }
  std::vector<float> carry(carry_size, 0.0f);
  std::vector<double> inference_ms;
  const double seconds = given(argv[3], std::string("SECONDS ") + argv[3]);
  const int steps = static_cast<int>(std::lround(seconds * rate_hz));
  if (steps < 1) fail(std::string("got SECONDS ") + argv[3] + "; expected one step of the policy or more");
  const int physics_steps = static_cast<int>(std::lround(1 / rate_hz / model->opt.timestep));
  for (int step = 0; step < steps && data->qpos[2] > lowest; ++step) {
    std::vector<float> observation = observe(model, data, table, constants, memory, step > 0);
    const int64_t shape[2] = {1, static_cast<int64_t>(observation.size())};
    OrtValue *inputs[2] = {}, *outputs[2] = {};
    const auto started = std::chrono::steady_clock::now();
    check(ort->CreateTensorWithDataAsOrtValue(cpu, observation.data(), observation.size() * sizeof(float), shape, 2,
                                              ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, &inputs[0]));
    check(ort->CreateTensorWithDataAsOrtValue(cpu, carry.data(), carry.size() * sizeof(float), carry_shape.data(),
                                              carry_shape.size(), ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, &inputs[1]));
    const char *input_names[] = {"observation", "carry"}, *output_names[] = {"action", "next_carry"};
    check(ort->Run(session, nullptr, input_names, inputs, 2, output_names, 2, outputs));
    float *action = nullptr, *next_carry = nullptr;
    check(ort->GetTensorMutableData(outputs[0], reinterpret_cast<void**>(&action)));
    check(ort->GetTensorMutableData(outputs[1], reinterpret_cast<void**>(&next_carry)));
    inference_ms.push_back(
        std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - started).count());
    for (int i = 0; i < model->nu; ++i) data->ctrl[i] = offset[i] + scale[i] * std::clamp(action[i], -1.0f, 1.0f);
    std::copy(next_carry, next_carry + carry.size(), carry.begin());
    for (OrtValue* value : {inputs[0], inputs[1], outputs[0], outputs[1]}) ort->ReleaseValue(value);
    for (int i = 0; i < physics_steps; ++i) mj_step(model, data);
    advance(data, constants, 1 / rate_hz, memory);
  }
  std::sort(inference_ms.begin(), inference_ms.end());
  std::printf("%.2f s: x %.2f m, y %.2f m, pelvis at %.2f m\n", data->time, data->qpos[0], data->qpos[1], data->qpos[2]);
  std::printf("inference: median %.3f ms, largest %.3f ms a step\n", inference_ms[inference_ms.size() / 2],
              inference_ms.back());
  const bool up = data->time > seconds - 0.02;
  mj_deleteData(data);
  mj_deleteModel(model);
  ort->ReleaseModelMetadata(about.metadata);
  ort->ReleaseMemoryInfo(cpu);
  ort->ReleaseSession(session);
  ort->ReleaseSessionOptions(options);
  ort->ReleaseEnv(env);
  return up ? 0 : 1;
}

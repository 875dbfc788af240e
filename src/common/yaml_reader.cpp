// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/yaml_reader.h"

#include <yaml-cpp/eventhandler.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <locale>
#include <optional>
#include <set>
#include <sstream>

#include "semantic_lidar_fusion/common/edit_distance.h"
#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {
namespace {

constexpr std::size_t kMaxBytes = 1 << 20;
constexpr int kMaxDepth = 32;
constexpr std::size_t kMaxNodes = 100000;

[[noreturn]] void fail(const std::string& source_name, const std::string& rule) {
  throw ConfigError({source_name + ": " + rule});
}

/// Whether a text nests so deeply that a recursive parser could exhaust its stack. It
/// overestimates: brackets in strings count, and so does indentation.
bool nestsTooDeeply(const std::string& text) {
  constexpr int kMaxBrackets = 100;
  constexpr int kMaxIndent = 250;
  int brackets = 0;
  int indent = 0;
  bool in_indent = true;
  for (const char c : text) {
    if (c == '[' || c == '{') {
      if (++brackets > kMaxBrackets) return true;
    } else if (c == ']' || c == '}') {
      brackets = std::max(0, brackets - 1);
    }
    if (c == '\n' || c == '\r') {
      in_indent = true;
      indent = 0;
    } else if (in_indent) {
      in_indent = c == ' ' || c == '\t' || c == '-' || c == '?' || c == ':';
      if (++indent > kMaxIndent) return true;
    }
  }
  return false;
}

/// yaml-cpp before 0.7 never ends where, within brackets, `]`, a control character (one of which
/// stands for the end of the text) or the end itself follows a colon directly: what YAML does not
/// have is refused, in strings and comments too (the guard must not be led astray), and a blank
/// helps against the last.
std::string harmless(const std::string& text, const std::string& source_name) {
#ifdef SLF_OLD_YAML_CPP
  std::size_t line = 1;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto c = static_cast<unsigned char>(text[i]);
    line += c == '\n';
    const auto place = [&] { return source_name + ":" + std::to_string(line); };
    if (c < ' ' && c != '\t' && c != '\n' && c != '\r') {
      fail(place(),
           "control character " + std::to_string(c) + "; YAML has none but tabs and ends of line");
    }
    if (c == ']' && i > 0 && text[i - 1] == ':') fail(place(), "':]' must have a blank within");
  }
  return text + " ";
#else
  static_cast<void>(source_name);
  return text;
#endif
}

class IgnoreEvents : public YAML::EventHandler {
 public:
  void OnDocumentStart(const YAML::Mark&) override {}
  void OnDocumentEnd() override {}
  void OnNull(const YAML::Mark&, YAML::anchor_t) override {}
  void OnAlias(const YAML::Mark&, YAML::anchor_t) override {}
  void OnScalar(const YAML::Mark&, const std::string&, YAML::anchor_t,
                const std::string&) override {}
  void OnSequenceStart(const YAML::Mark&, const std::string&, YAML::anchor_t,
                       YAML::EmitterStyle::value) override {}
  void OnSequenceEnd() override {}
  void OnMapStart(const YAML::Mark&, const std::string&, YAML::anchor_t,
                  YAML::EmitterStyle::value) override {}
  void OnMapEnd() override {}
};

/// Documents of a text, at most 2. YAML::LoadAll never ends on some texts, such as ",": they hold
/// empty documents without end.
int countDocuments(const std::string& text) {
  std::istringstream stream(text);
  YAML::Parser parser(stream);
  IgnoreEvents ignore;
  int documents = 0;
  while (documents < 2 && parser.HandleNextDocument(ignore)) ++documents;
  return documents;
}

YAML::Node copyNode(const YAML::Node& node, int depth, std::size_t* nodes,
                    const std::string& source_name) {
  if (depth > kMaxDepth) {
    fail(source_name, "nests deeper than " + std::to_string(kMaxDepth) +
                          " levels, or an alias refers to itself");
  }
  if (++*nodes > kMaxNodes) {
    fail(source_name, "holds more than " + std::to_string(kMaxNodes) + " values");
  }
  if (!node.IsDefined() || node.IsNull()) return YAML::Node(YAML::NodeType::Null);
  if (node.IsScalar()) return YAML::Node(node.Scalar());
  YAML::Node copy(node.IsMap() ? YAML::NodeType::Map : YAML::NodeType::Sequence);
  for (const auto& item : node) {
    if (node.IsMap()) {
      copy.force_insert(copyNode(item.first, depth + 1, nodes, source_name),
                        copyNode(item.second, depth + 1, nodes, source_name));
    } else {
      copy.push_back(copyNode(item, depth + 1, nodes, source_name));
    }
  }
  return copy;
}

std::optional<double> toNumber(const YAML::Node& node) {
  if (!node.IsScalar()) return {};
  std::istringstream stream(node.Scalar());
  stream.imbue(std::locale::classic());
  double value = 0;
  stream >> std::noskipws >> value;
  if (stream.fail() || stream.peek() != std::istringstream::traits_type::eof()) return {};
  if (!std::isfinite(value)) return {};
  return value;
}

std::string format(double value) {
  std::ostringstream stream;
  stream.imbue(std::locale::classic());
  stream.precision(10);
  stream << value;
  return stream.str();
}

std::string ruleOf(const NumberRange& range) {
  constexpr double kNone = std::numeric_limits<double>::max();
  std::string rule;
  if (range.least > -kNone) {
    rule += (range.open_least     ? " above "
             : range.most < kNone ? " from "
                                  : " of at least ") +
            format(range.least);
  }
  if (range.most < kNone) {
    rule +=
        (range.least > -kNone && !range.open_least ? " to " : ", at most ") + format(range.most);
  }
  return (rule.empty() ? "a finite number" : "a number") + rule;
}

bool within(double value, const NumberRange& range) {
  return value <= range.most && (range.open_least ? value > range.least : value >= range.least);
}

std::string join(const std::vector<std::string>& names, const std::string& separator) {
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : separator) + name;
  return text;
}

}  // namespace

YAML::Node copyTree(const YAML::Node& node, const std::string& source_name) {
  std::size_t nodes = 0;
  return copyNode(node, 0, &nodes, source_name);
}

YAML::Node parseYaml(const std::string& given, const std::string& source_name) {
  if (given.size() > kMaxBytes) {
    fail(source_name, "is longer than " + std::to_string(kMaxBytes) + " bytes");
  }
  if (nestsTooDeeply(given)) fail(source_name, "nests too deeply for a configuration");
  const std::string text = harmless(given, source_name);
  YAML::Node root;
  try {
    const int documents = countDocuments(text);
    if (documents > 1) fail(source_name, "must hold one YAML document and nothing beside it");
    if (documents == 1) root = YAML::Load(text);
  } catch (const YAML::Exception& error) {
    if (error.mark.is_null()) fail(source_name, "is not YAML: " + error.msg);
    fail(source_name + ":" + std::to_string(error.mark.line + 1) + ":" +
             std::to_string(error.mark.column + 1),
         "is not YAML: " + error.msg);
  }
  return root.IsNull() ? YAML::Node(YAML::NodeType::Map) : copyTree(root, source_name);
}

YAML::Node parseYamlFile(const std::string& path) {
  // A pipe would be waited for, and a device may never end.
  std::error_code error;
  if (std::filesystem::is_other(path, error)) fail(path, "is a pipe or a device; must be a file");
  std::ifstream file(path, std::ios::binary);
  std::string text(kMaxBytes + 1, '\0');
  file.read(&text[0], static_cast<std::streamsize>(text.size()));
  // A folder opens like a file and fails at the first byte.
  if (!file.is_open() || file.bad()) fail(path, "cannot be read; must be a readable file");
  text.resize(static_cast<std::size_t>(file.gcount()));
  // OpenCV begins its files with "%YAML:1.0", which is no directive of YAML.
  if (text.compare(0, 6, "%YAML:") == 0) text[0] = '#';
  return parseYaml(text, path);
}

std::string describeValue(const YAML::Node& node) {
  if (!node.IsDefined()) return "(missing)";
  if (node.IsNull()) return "(empty)";
  if (node.IsSequence()) return "(a list of " + std::to_string(node.size()) + ")";
  if (node.IsMap()) return "(a map of " + std::to_string(node.size()) + ")";
  constexpr std::size_t kLongest = 80;
  std::string text = node.Scalar();
  if (text.empty()) return "''";
  if (text.size() > kLongest) text = text.substr(0, kLongest) + "...";
  for (char& c : text) {
    if (std::iscntrl(static_cast<unsigned char>(c))) c = '?';
  }
  return text;
}

namespace {

std::string lower(std::string text) {
  for (char& c : text) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return text;
}

}  // namespace

std::string nearestName(const std::string& word, const std::vector<std::string>& names) {
  constexpr std::size_t kLongest = 64;
  if (word.size() > kLongest) return {};
  std::string nearest;
  std::size_t least = std::max<std::size_t>(2, word.size() / 3) + 1;
  for (const std::string& name : names) {
    const std::size_t distance = editDistance(lower(word), lower(name));
    // A word that shares no letter with the name is not a misspelling of it.
    if (distance < least && distance < std::max(word.size(), name.size())) {
      least = distance;
      nearest = name;
    }
  }
  return nearest;
}

YamlSection::YamlSection(const YAML::Node& node, std::string path,
                         std::vector<std::string>* problems)
    : node_(YAML::NodeType::Map), path_(std::move(path)), problems_(problems) {
  if (!node.IsDefined() || node.IsNull()) return;
  if (node.IsMap()) {
    node_.reset(node);
    return;
  }
  problems_->push_back((path_.empty() ? "" : path_ + " = ") + describeValue(node) +
                       ": must be a map (key: value)");
}

std::string YamlSection::pathOf(const std::string& key) const {
  return path_.empty() ? key : path_ + "." + key;
}

YamlSection YamlSection::child(const std::string& key) {
  YamlSection section(get(key), pathOf(key), problems_);
  section.parent_ = this;
  section.key_in_parent_ = key;
  return section;
}

bool YamlSection::has(const std::string& key) const {
  return const_cast<const YAML::Node&>(node_)[key].IsDefined();
}

YAML::Node YamlSection::get(const std::string& key) {
  return present(key) ? node_[key] : YAML::Node(YAML::NodeType::Undefined);
}

bool YamlSection::present(const std::string& key) {
  known_.push_back(key);
  return has(key);
}

void YamlSection::problem(const std::string& key, const std::string& rule) {
  const YAML::Node value = const_cast<const YAML::Node&>(node_)[key];
  problems_->push_back(pathOf(key) + " = " + describeValue(value) + ": " + rule);
}

void YamlSection::number(const std::string& key, double* value, const NumberRange& range) {
  if (present(key)) {
    const std::optional<double> read = toNumber(node_[key]);
    if (read && within(*read, range)) {
      *value = *read;
    } else {
      problem(key, "must be " + ruleOf(range));
    }
  }
  keep(key, YamlTree::number(*value));
}

void YamlSection::integer(const std::string& key, int* value, int least, int most) {
  if (present(key)) {
    const std::optional<double> read = toNumber(node_[key]);
    if (read && *read >= least && *read <= most && std::floor(*read) == *read) {
      *value = static_cast<int>(*read);
    } else {
      problem(key, "must be a whole number from " + std::to_string(least) + " to " +
                       std::to_string(most));
    }
  }
  keep(key, YamlTree::integer(*value));
}

void YamlSection::boolean(const std::string& key, bool* value) {
  if (present(key) && !YAML::convert<bool>::decode(node_[key], *value)) {
    problem(key, "must be true or false");
  }
  keep(key, YamlTree::boolean(*value));
}

void YamlSection::text(const std::string& key, std::string* value) {
  if (present(key)) {
    if (node_[key].IsScalar()) {
      *value = node_[key].Scalar();
    } else {
      problem(key, "must be a text");
    }
  }
  keep(key, YamlTree::text(*value));
}

void YamlSection::texts(const std::string& key, std::vector<std::string>* values) {
  if (present(key)) readTexts(key, values);
  YamlTree list = YamlTree::list();
  for (const std::string& value : *values) list.add(YamlTree::text(value));
  keep(key, std::move(list));
}

void YamlSection::readTexts(const std::string& key, std::vector<std::string>* values) {
  const YAML::Node list = node_[key];
  if (!list.IsSequence()) {
    problem(key, "must be a list of texts");
    return;
  }
  values->clear();
  for (std::size_t i = 0; i < list.size(); ++i) {
    const YAML::Node item = list[i];
    if (item.IsScalar()) {
      values->push_back(item.Scalar());
    } else {
      problems_->push_back(pathOf(key) + "[" + std::to_string(i) + "] = " + describeValue(item) +
                           ": must be a text");
    }
  }
}

bool YamlSection::numbers(const std::string& key, std::vector<double>* values,
                          const NumberRange& range) {
  const bool good = !present(key) || readNumbers(key, values, range);
  YamlTree list = YamlTree::list();
  for (const double value : *values) list.add(YamlTree::number(value));
  keep(key, std::move(list));
  return good;
}

bool YamlSection::readNumbers(const std::string& key, std::vector<double>* values,
                              const NumberRange& range) {
  const YAML::Node list = node_[key];
  if (!list.IsSequence()) {
    problem(key, "must be a list of numbers");
    return false;
  }
  bool good = true;
  values->clear();
  for (std::size_t i = 0; i < list.size(); ++i) {
    const YAML::Node item = list[i];
    const std::optional<double> read = toNumber(item);
    if (read && within(*read, range)) {
      values->push_back(*read);
    } else {
      good = false;
      problems_->push_back(pathOf(key) + "[" + std::to_string(i) + "] = " + describeValue(item) +
                           ": must be " + ruleOf(range));
    }
  }
  return good;
}

int YamlSection::indexOfChoice(const std::string& key, const std::vector<std::string>& names,
                               const std::vector<std::string>& shown) {
  if (!present(key)) return -1;
  const YAML::Node node = node_[key];
  if (node.IsScalar()) {
    const auto found = std::find(names.begin(), names.end(), node.Scalar());
    if (found != names.end()) return static_cast<int>(found - names.begin());
  }
  problem(key, "must be one of " + join(shown, ", "));
  return -1;
}

void YamlSection::finish() {
  if (parent_ != nullptr) parent_->keep(key_in_parent_, resolved_);
  std::set<std::string> seen;
  for (const auto& item : node_) {
    if (!item.first.IsScalar()) {
      problems_->push_back(pathOf(describeValue(item.first)) + ": a key must be a text");
      continue;
    }
    const std::string key = item.first.Scalar();
    if (!seen.insert(key).second) {
      problems_->push_back(pathOf(describeValue(item.first)) + " = " + describeValue(item.second) +
                           ": the key is given twice");
    } else if (std::find(known_.begin(), known_.end(), key) == known_.end()) {
      const std::string nearest = nearestName(key, known_);
      problems_->push_back(pathOf(describeValue(item.first)) + " = " + describeValue(item.second) +
                           ": unknown key; " +
                           (nearest.empty() ? "known here: " + join(known_, ", ")
                                            : "did you mean '" + nearest + "'?"));
    }
  }
}

}  // namespace semantic_lidar_fusion

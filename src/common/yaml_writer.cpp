// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/yaml_writer.h"

#include <algorithm>
#include <cctype>
#include <cstdio>
#include <limits>
#include <locale>
#include <sstream>

namespace semantic_lidar_fusion {
namespace {

bool isPlainCharacter(char c) {
  return std::isalnum(static_cast<unsigned char>(c)) || c == '_' || c == '/' || c == '.' ||
         c == '-';
}

/// Whether a parser of either version reads the text, unquoted, as that text.
bool isPlain(const std::string& text) {
  static const char* const kWords[] = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"};
  if (text.empty() || !(std::isalpha(static_cast<unsigned char>(text[0])) || text[0] == '/')) {
    return false;
  }
  if (!std::all_of(text.begin(), text.end(), isPlainCharacter)) return false;
  std::string lower = text;
  std::transform(lower.begin(), lower.end(), lower.begin(),
                 [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
  return std::none_of(std::begin(kWords), std::end(kWords),
                      [&](const char* word) { return lower == word; });
}

std::string quoted(const std::string& text) {
  std::string result = "\"";
  for (const char c : text) {
    const auto byte = static_cast<unsigned char>(c);
    if (c == '"' || c == '\\') {
      result += '\\';
      result += c;
    } else if (byte < 0x20 || byte == 0x7f) {
      char escape[8];
      std::snprintf(escape, sizeof(escape), "\\x%02X", static_cast<unsigned>(byte));
      result += escape;
    } else {
      result += c;
    }
  }
  return result + '"';
}

std::string written(double value, int digits) {
  std::ostringstream stream;
  stream.imbue(std::locale::classic());
  stream.precision(digits);
  stream << value;
  return stream.str();
}

/// NaN where the digits lie beyond the greatest number.
double readBack(const std::string& text) {
  std::istringstream stream(text);
  stream.imbue(std::locale::classic());
  double value = 0;
  stream >> value;
  return stream.fail() ? std::numeric_limits<double>::quiet_NaN() : value;
}

}  // namespace

YamlTree YamlTree::scalar(std::string text) {
  YamlTree tree;
  tree.written_ = std::move(text);
  return tree;
}

YamlTree YamlTree::number(double value) {
  std::string text;
  for (const int digits : {15, 16, 17}) {
    text = written(value, digits);
    if (readBack(text) == value) break;
  }
  // YAML 1.1 takes 1e-05 for a text and 1 for a whole number.
  if (text.find('.') == std::string::npos) {
    const std::size_t exponent = std::min(text.find('e'), text.size());
    text.insert(exponent, ".0");
  }
  return scalar(text);
}

YamlTree YamlTree::integer(long long value) { return scalar(std::to_string(value)); }
YamlTree YamlTree::boolean(bool value) { return scalar(value ? "true" : "false"); }
YamlTree YamlTree::text(const std::string& value) {
  return scalar(isPlain(value) ? value : quoted(value));
}

YamlTree YamlTree::map() {
  YamlTree tree;
  tree.kind_ = Kind::kMap;
  return tree;
}

YamlTree YamlTree::list() {
  YamlTree tree;
  tree.kind_ = Kind::kList;
  return tree;
}

void YamlTree::put(const std::string& key, YamlTree value) {
  for (auto& item : items_) {
    if (item.first == key) {
      item.second = std::move(value);
      return;
    }
  }
  items_.emplace_back(key, std::move(value));
}

void YamlTree::add(YamlTree value) { items_.emplace_back(std::string(), std::move(value)); }

const YamlTree* YamlTree::find(const std::string& key) const {
  for (const auto& item : items_) {
    if (kind_ == Kind::kMap && item.first == key) return &item.second;
  }
  return nullptr;
}

bool YamlTree::isFlat() const {
  return kind_ == Kind::kScalar || items_.empty() ||
         (kind_ == Kind::kList && std::all_of(items_.begin(), items_.end(), [](const auto& item) {
            return item.second.kind_ == Kind::kScalar;
          }));
}

std::string YamlTree::flow() const {
  if (kind_ == Kind::kScalar) return written_;
  std::string text;
  for (const auto& item : items_) text += (text.empty() ? "" : ", ") + item.second.written_;
  return kind_ == Kind::kMap ? "{}" : "[" + text + "]";
}

void YamlTree::write(int indent, bool continues_line, std::string* out) const {
  for (const auto& [key, value] : items_) {
    if (!continues_line) out->append(static_cast<std::size_t>(indent), ' ');
    continues_line = false;
    *out += kind_ == Kind::kList ? "-" : (isPlain(key) ? key : quoted(key)) + ":";
    if (value.isFlat()) {
      *out += " " + value.flow() + "\n";
      continue;
    }
    // What stands in a list begins on the line of its dash.
    *out += kind_ == Kind::kList ? " " : "\n";
    value.write(indent + 2, kind_ == Kind::kList, out);
  }
}

std::string YamlTree::toYaml() const {
  if (isFlat()) return flow() + "\n";
  std::string text;
  write(0, false, &text);
  return text;
}

}  // namespace semantic_lidar_fusion

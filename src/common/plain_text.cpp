// SPDX-License-Identifier: MIT
#include "semantic_lidar_fusion/common/plain_text.h"

#include <cstdio>

namespace semantic_lidar_fusion {
namespace {

bool isContinuation(const std::string& text, std::size_t i) {
  return i < text.size() && (static_cast<unsigned char>(text[i]) & 0xC0u) == 0x80u;
}

/// Bytes of the character at `i`; 0 if it is not printable UTF-8. U+0080..U+009F are controls, and
/// U+2028, U+2029 and the marks of direction can break or reorder a line.
std::size_t printableAt(const std::string& text, std::size_t i) {
  const auto lead = static_cast<unsigned char>(text[i]);
  if (lead < 0x80) return lead >= 0x20 && lead != 0x7F ? 1 : 0;
  const std::size_t size = lead >= 0xC2 && lead <= 0xDF   ? 2
                           : lead >= 0xE0 && lead <= 0xEF ? 3
                           : lead >= 0xF0 && lead <= 0xF4 ? 4
                                                          : 0;
  if (size == 0) return 0;
  unsigned code = lead & (0x7Fu >> size);
  for (std::size_t k = 1; k < size; ++k) {
    if (!isContinuation(text, i + k)) return 0;
    code = code << 6 | (static_cast<unsigned char>(text[i + k]) & 0x3Fu);
  }
  const bool is_shortest =
      size == 2 || (size == 3 && code >= 0x800) || (size == 4 && code >= 0x10000);
  const bool is_surrogate = code >= 0xD800 && code <= 0xDFFF;
  const bool is_control = code < 0xA0 || (code >= 0x2028 && code <= 0x202E) ||
                          (code >= 0x2066 && code <= 0x2069) || code == 0xFEFF;
  return is_shortest && code <= 0x10FFFF && !is_surrogate && !is_control ? size : 0;
}

/// Escapes what starts in [begin, end).
std::string escaped(const std::string& text, std::size_t begin, std::size_t end) {
  std::string result;
  for (std::size_t i = begin; i < end;) {
    const std::size_t size = printableAt(text, i);
    if (size > 0) {
      result.append(text, i, size);
      i += size;
    } else {
      char code[8];
      std::snprintf(code, sizeof(code), "\\x%02x", static_cast<unsigned char>(text[i]));
      result += code;
      ++i;
    }
  }
  return result;
}

}  // namespace

std::string plainText(const std::string& text, std::size_t longest) {
  if (text.size() <= longest) return escaped(text, 0, text.size());
  // Not within a character.
  std::size_t head = longest * 2 / 3, tail = text.size() - longest / 3;
  while (head > 0 && isContinuation(text, head)) --head;
  while (isContinuation(text, tail)) ++tail;
  return escaped(text, 0, head) + "...(" + std::to_string(text.size()) + " bytes)..." +
         escaped(text, tail, text.size());
}

}  // namespace semantic_lidar_fusion

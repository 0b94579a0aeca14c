// The wire of the twin in C++17 with plain POSIX sockets: no flexdt, no JSON library on this side.
//
//   g++ -std=c++17 -O2 -o client examples/wire/client.cpp && ./client [HOST [PORT]]
//
// Moves the stage, asks for a projection and prints its size, mean and largest line integral. Numbers and
// strings are picked out of the answers by name; a program of your own would use its JSON library.
#include <netdb.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <cstdint>
#include <cstring>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

class Twin {
 public:
  Twin(const std::string& host, const std::string& port) {
    addrinfo hints{};
    hints.ai_socktype = SOCK_STREAM;
    addrinfo* found = nullptr;
    if (getaddrinfo(host.c_str(), port.c_str(), &hints, &found) != 0)
      throw std::runtime_error("no such host: " + host);
    for (addrinfo* at = found; at != nullptr && socket_ < 0; at = at->ai_next) {
      socket_ = socket(at->ai_family, at->ai_socktype, at->ai_protocol);
      if (socket_ >= 0 && connect(socket_, at->ai_addr, at->ai_addrlen) != 0) {
        close(socket_);
        socket_ = -1;
      }
    }
    freeaddrinfo(found);
    if (socket_ < 0) throw std::runtime_error("no server at " + host + ":" + port);
  }
  ~Twin() { close(socket_); }
  Twin(const Twin&) = delete;
  Twin& operator=(const Twin&) = delete;

  // Send a request; returns the answer's line, passing over events. Throws on a JSON-RPC error.
  std::string call(const std::string& method, const std::string& params) {
    const std::string id = std::to_string(++count_);
    send(R"({"jsonrpc":"2.0","id":)" + id + R"(,"method":")" + method + R"(","params":)" + params + "}\n");
    while (true) {
      const std::string line = receive();
      if (line.find(R"("method":"event")") != std::string::npos) continue;
      if (line.find(R"("error":)") != std::string::npos) throw std::runtime_error(method + ": " + line);
      return line;
    }
  }

 private:
  void send(const std::string& text) {
    for (std::size_t sent = 0; sent < text.size();) {
      const ssize_t some = ::send(socket_, text.data() + sent, text.size() - sent, MSG_NOSIGNAL);
      if (some <= 0) throw std::runtime_error("the connection broke");
      sent += static_cast<std::size_t>(some);
    }
  }

  std::string receive() {
    std::size_t end;
    while ((end = pending_.find('\n')) == std::string::npos) {
      std::array<char, 65536> chunk;
      const ssize_t some = recv(socket_, chunk.data(), chunk.size(), 0);
      if (some <= 0) throw std::runtime_error("the server closed the connection");
      pending_.append(chunk.data(), static_cast<std::size_t>(some));
    }
    const std::string line = pending_.substr(0, end);
    pending_.erase(0, end + 1);
    return line;
  }

  int socket_ = -1;
  long count_ = 0;
  std::string pending_;
};

// What stands behind "name": in an answer.
std::string after(const std::string& answer, const std::string& name) {
  const std::string key = "\"" + name + "\":";
  const std::size_t at = answer.find(key);
  if (at == std::string::npos) throw std::runtime_error("no " + name + " in " + answer.substr(0, 200));
  return answer.substr(at + key.size());
}

std::vector<std::uint8_t> base64(const std::string& text) {
  static const std::string alphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::vector<std::uint8_t> out;
  std::uint32_t bits = 0;
  int held = 0;
  for (const char c : text) {
    const std::size_t value = alphabet.find(c);
    if (value == std::string::npos) break;  // '=' at the end
    bits = bits << 6 | static_cast<std::uint32_t>(value);
    if ((held += 6) >= 8) out.push_back(static_cast<std::uint8_t>(bits >> (held -= 8)));
  }
  return out;
}

int main(int count, char** words) try {
  Twin twin(count > 1 ? words[1] : "127.0.0.1", count > 2 ? words[2] : "55000");
  twin.call("session.hello", R"({"protocol":"1.0","client":"C++"})");
  twin.call("sample.set", R"({"name":"normal-5"})");
  twin.call("axes.move", R"({"targets":{"tra_obj":0,"mag_obj":600,"rot_obj":0},"wait":true})");
  const std::string answer = twin.call("projection.get", R"({"kind":"line_integral","binning":4})");

  const std::string shape = after(answer, "shape");  // [rows,columns]
  std::size_t digits = 0;
  const std::size_t rows = std::stoul(shape.substr(1), &digits);
  const std::size_t columns = std::stoul(shape.substr(digits + 2));
  std::string data = after(answer, "data").substr(1);
  data.erase(data.find('"'));
  const std::vector<std::uint8_t> bytes = base64(data);
  std::vector<float> pixels(rows * columns);
  if (bytes.size() != pixels.size() * sizeof(float)) throw std::runtime_error("shape and data differ");
  std::memcpy(pixels.data(), bytes.data(), bytes.size());  // both little-endian

  double sum = 0.0, most = 0.0;
  for (const float p : pixels) {
    sum += p;
    if (p > most) most = p;
  }
  std::cout << rows << " x " << columns << ", mean " << sum / static_cast<double>(pixels.size())
            << ", largest " << most << "\n";
} catch (const std::exception& error) {
  std::cerr << error.what() << "\n";
  return 1;
}
